"""The stamps among the columns of a log, and the unit of time that its other columns show."""

import dataclasses

import numpy as np
from jaxtyping import Float

from covariant.calibration.identification._roles import LogColumns
from covariant.logs import Register, episodes_fault, unit_factor
from scalargraph.errors import InputError

CLOCKS = ((500.0, "ms"), (5e5, "us"), (np.inf, "ns"))
"""Upper bounds of the median step of the stamps, and the unit in which they then are, if they are not seconds."""
SECONDS, NO_SECONDS = 0.5, 30.0
"""Steps below which stamps are certainly seconds, and from which they are certainly none."""
SAME_UNIT = 3.0
"""Largest ratio of a velocity to the slope of its position, either way, in the unit of time that they are in."""


def find_stamps(log: LogColumns) -> str:
    """The column of stamps: what is called so, or the only other one that rises; what counts rows last."""
    rising = [name for name, values in log.values.items() if _rises(Register.continued(values))]
    called = ([name for name in rising if log.roles.get(name) == role] for role in ("t", ""))
    named, unnamed = ([n for n in names if not counts_rows(log[n])] or names for names in called)
    candidates = named or unnamed
    for name in () if named else log.of("t"):
        _refuse_episodes(log, name)
    if len(candidates) == 1:
        return candidates[0]
    what = f"{', '.join(candidates)} all rise" if candidates else "no column of stamps rises"
    raise InputError(f'{what} from row to row; name the one of the stamps by `columns["t"]`{log.listed}')


def refuse_stamps(log: LogColumns) -> None:
    """Raise `ValueError` for stamps that do not rise, or only count the rows."""
    _refuse_episodes(log, log.t)
    t = log[log.t]
    if len(t) < 2 or not _rises(t):
        raise InputError(
            f'the stamps {log.t} do not rise from row to row; sort the log, or name others by `columns["t"]`'
        )
    if counts_rows(t) and "t" not in log.units and log.unit(log.t, "t") is None:
        raise InputError(
            f"column {log.t!r} counts rows from {t[0]:g}, and is no clock: say how long a row takes by "
            "`overrides=['units.t=\"0.01 s\"']` for 100 rows a second"
        )


def _rises(values: Float[np.ndarray, "T"]) -> bool:
    return bool(np.isfinite(values).all() and (np.diff(values) > 0).all())


def counts_rows(values: Float[np.ndarray, "T"]) -> bool:
    """Whether whole numbers rise by one from row to row."""
    return bool(len(values) > 2 and (values % 1 == 0).all() and np.median(np.diff(values)) == 1)


def seconds(log: LogColumns, q: tuple[str, ...]) -> Float[np.ndarray, "T"]:
    """The stamps (T,) [s]; rows where there are none."""
    if not log.t:
        return log.clock
    return log[log.t] * unit_factor(log.unit(log.t, "t") or log.ask(unit_of_time, log, q, otherwise="s"))


def unit_of_time(log: LogColumns, q: tuple[str, ...]) -> str:
    """The unit of stamps that state none: by a velocity in the log, or by their step."""
    t = log[log.t]
    step, whole = float(np.median(np.diff(t))), bool(np.abs(t - np.rint(t)).max() < 1e-6)
    larger = next(unit for limit, unit in CLOCKS if step < limit)
    if step < SECONDS:
        return "s"
    in_seconds = dataclasses.replace(log, clock=t)
    ratios = [in_seconds.slope_ratio(position, name) for position in q for name in log.of("v")]
    # In the right unit a velocity is the slope itself, or nearly so in degrees that were taken for radians.
    known = [abs(ratio) for ratio in ratios if ratio]
    for unit, factor in (("s", 1.0), (larger, 1 / unit_factor(larger))) if known else ():
        if is_near(np.median(known) / factor):
            return unit
    if whole or step >= NO_SECONDS:
        return larger
    raise InputError(
        f"column {log.t!r} goes on by {step:.4g} from row to row, which may be seconds or milliseconds; say which by "
        "`overrides=['units.t=\"s\"']`"
    )


def _refuse_episodes(log: LogColumns, name: str) -> None:
    """Raise `ValueError` for stamps that start again with each episode."""
    fault = episodes_fault(log[name], log.values, log.values.__getitem__)
    if fault is not None:
        raise InputError(f"column {name!r} {fault}")


def is_near(ratio: float) -> bool:
    """Whether a velocity and the slope of its position are in one unit of time."""
    return 1 / SAME_UNIT < ratio < SAME_UNIT
