"""What the columns of a log seem to be, by their names and by their content."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_WORDS = {
    "left out": "true truth ref reference des desired goal target set setpoint raw",
    "v": "v w dq qd dqdt dot qdot dth dtheta om omega vel velocity velocities speed rate gyro",
    "u": "u tau torque torques tq trq current force effort motor volt voltage cmd command pwm input",
    "t": "t time times timestamp timestamps stamp stamps sec secs seconds",
    "q": "q th theta phi psi angle ang pos position positions enc encoder joint x",
}
"""Words in the names of columns, by what they are taken for; the first that is found counts."""
UNITS = ((0.5, "s", 1.0), (500.0, "ms", 1e3), (5e5, "us", 1e6), (np.inf, "ns", 1e9))
"""Median steps of stamps below which they are taken for seconds, milliseconds and so on."""
SAME = 0.95
"""Least correlation of a column with the slope of a position with which it is taken for a velocity."""
FEWEST_GAPS = 10
"""Number of gaps between values from which it is told whether positions are whole ticks apart."""
OFF_TICK = 0.1
"""How far differences of positions may be from whole ticks, as a fraction of one."""


class Draft(NamedTuple):
    """What the columns of a log are taken for.

    - `t`, `q`, `u`, `v`: names of the columns of stamps, positions, inputs and logged velocities.
    - `left_out`: names of the other columns.
    - `rate`: samples a second [Hz]; `rows`: their number.
    - `quantum`: one tick of the positions where they are whole ticks apart, otherwise None.
    - `noise`: standard deviation of their noise, from third differences; an upper bound, since motion counts as well.
    - `span` (n, 2): least and largest value of each position.
    """

    t: str
    q: tuple[str, ...]
    u: tuple[str, ...]
    v: tuple[str, ...]
    left_out: tuple[str, ...]
    rate: float
    rows: int
    quantum: float | None
    noise: float
    span: Float[np.ndarray, "n 2"]


def draft(columns: Mapping[str, np.ndarray], given: Mapping[str, Sequence[str] | None] | None = None) -> Draft:
    """What the columns (T,) of a log are taken for, by their names and, where these say nothing, by their content.

    - `given`: names for t, q, u or v that are known and not guessed.

    Raises `ValueError`, one line that says which columns were seen, where it is not clear which are the stamps, the
    positions or the inputs, and where the stamps are not in seconds.
    """
    given = {key: tuple(names) for key, names in (given or {}).items() if names is not None}
    for name in [name for names in given.values() for name in names]:
        if name not in columns:
            raise ValueError(f"there is no column {name!r} of numbers{_seen(columns)}")
    fixed = {name for names in given.values() for name in names}
    kinds = {name: _kind(name) for name in columns if name not in fixed}
    t = given["t"][0] if "t" in given else _stamps(columns, kinds)
    step = _seconds(t, columns[t])
    q = given.get("q") or tuple(name for name, kind in kinds.items() if kind == "q" and name != t)
    if not q:
        raise ValueError(f"no column is named like a position, as q1 or theta; name them by --q{_seen(columns)}")
    _one_family("q", q, given, columns)
    u = given.get("u") or tuple(name for name, kind in kinds.items() if kind == "u")
    _one_family("u", u, given, columns)
    if len(u) > len(q):
        raise ValueError(f"{len(u)} inputs ({', '.join(u)}) for {len(q)} positions; name them by --u{_seen(columns)}")
    v = given.get("v") or tuple(name for name, kind in kinds.items() if kind == "v")
    if not v:
        unknown = [name for name, kind in kinds.items() if kind == "" and name != t]
        v = tuple(name for p in q for name in unknown if _is_slope(columns[t], columns[p], columns[name]))
    v = v if len(v) == len(q) else ()
    y = np.column_stack([columns[name] for name in q])
    if np.isnan(y[0]).any():
        raise ValueError(f"row 1 lacks a position ({', '.join(q)}); cut the log to begin later")
    return Draft(
        t,
        q,
        u,
        v,
        tuple(name for name in columns if name not in (t, *q, *u, *v)),
        1 / step,
        len(y),
        _tick(y),
        float(np.sqrt(np.nanmean(np.diff(y, 3, axis=0) ** 2) / 20)) if len(y) > 4 else 0.0,
        np.stack([np.nanmin(y, axis=0), np.nanmax(y, axis=0)], axis=1),
    )


def _seen(columns: Mapping[str, np.ndarray]) -> str:
    return f"; the columns of numbers are {', '.join(columns) or 'none'}"


def _kind(name: str) -> str:
    """What a name is taken for, a key of `_WORDS`; empty where it says nothing."""
    words = set(re.findall(r"[a-z]+", name.lower()))
    return next((kind for kind, known in _WORDS.items() if words & set(known.split())), "")


def _stamps(columns: Mapping[str, np.ndarray], kinds: Mapping[str, str]) -> str:
    rising = [name for name, values in columns.items() if np.isfinite(values).all() and (np.diff(values) > 0).all()]
    named = [name for name in rising if kinds.get(name) == "t"]
    found = named or [name for name in rising if kinds.get(name) == ""]
    if len(found) == 1:
        return found[0]
    what = f"{', '.join(found)} all rise from row to row" if found else "no column of stamps rises from row to row"
    raise ValueError(f"{what}; name the one of the stamps by --t{_seen(columns)}")


def _seconds(name: str, t: np.ndarray) -> float:
    """The median step of the stamps [s]; raises `ValueError` where they do not seem to be seconds."""
    if len(t) < 2 or not (np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise ValueError(f"the stamps {name} do not rise from row to row; sort the log, or name others by --t")
    step = float(np.median(np.diff(t)))
    unit, factor = next((unit, factor) for most, unit, factor in UNITS if step < most)
    if unit != "s":
        raise ValueError(
            f"the stamps {name} step by {step:g}, which seems to be {unit}, and stamps are read in seconds; divide the "
            f"column by {factor:g}"
        )
    return step


def _one_family(key: str, names: Sequence[str], given: Mapping[str, Sequence[str]], columns) -> None:
    """Raise `ValueError` where names such as q1, q2 and th1, th2 say that there are several kinds of them."""
    stems = {re.sub(r"[0-9]+", "#", name) for name in names}
    if key not in given and 1 < len(stems) < len(names):
        raise ValueError(f"{', '.join(names)} may all be {key}; name those that are by --{key}{_seen(columns)}")


def _is_slope(t: np.ndarray, y: np.ndarray, v: np.ndarray) -> bool:
    """Whether a column follows the slope of a position."""
    slope = np.gradient(y, t)
    both = np.isfinite(slope) & np.isfinite(v)
    if both.sum() < 10 or np.ptp(v[both]) == 0 or np.ptp(slope[both]) == 0:
        return False
    return bool(np.corrcoef(slope[both], v[both])[0, 1] > SAME)


def _tick(y: np.ndarray) -> float | None:
    """The tick that all positions are whole multiples apart, from the gaps between their values, or None."""
    gaps: np.ndarray = np.concatenate([np.diff(np.unique(column[np.isfinite(column)])) for column in y.T])
    gaps = gaps[gaps > 1e-6 * np.nanmax(np.abs(y))]
    if len(gaps) < FEWEST_GAPS:
        return None
    least = float(np.quantile(gaps, 0.02))
    few = np.asarray(gaps, float)[gaps < 50 * least]
    ticks = np.round(few / least)
    if np.quantile(np.abs(few / least - ticks), 0.95) > OFF_TICK:
        return None
    return float(np.sum(few) / np.sum(ticks))
