"""What the columns of a log seem to be, by their names and by their content."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs import check_unit, unit_factor

_WORDS = {
    "left out": "true truth ref reference des desired goal target set setpoint raw",
    "v": "v w dq qd dqdt dot qdot dth dtheta om omega vel velocity velocities speed rate gyro",
    "u": "u tau torque torques tq trq current force effort motor volt voltage cmd command pwm input",
    "t": "t time times timestamp timestamps stamp stamps sec secs seconds",
    "q": "q th theta phi psi angle ang pos position positions enc encoder joint x",
}
"""Words in the names of columns, by what they are taken for; the first that is found counts."""
CLOCKS = ((0.5, "s"), (500.0, "ms"), (5e5, "us"), (np.inf, "ns"))
"""Median steps of stamps below which they are taken for seconds, milliseconds and so on."""
DEGREES = 50.0
"""Angles that span more than this [rad] are more likely degrees."""
_MEANT = {"t": "s", "q": "rad", "u": "N m", "v": "rad/s"}
"""Units in which a model file has the columns where it says nothing."""
_IN_NAME = re.compile(r"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$|_(deg|degrees|rad|ms|us|ns|s|turns?|rev|rpm|mNm|Nm)$")
"""The unit at the end of the name of a column, as in `q1 [deg]`, `time (ms)` or `angle_deg`."""
_PLAIN = {"degrees": "deg", "deg/sec": "deg/s", "rad/sec": "rad/s", "seconds": "s", "degree": "deg"}
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
    - `span` (n, 2): least and largest value of each position, as logged.
    - `units`: by the field t, q, u or v, the units of its columns where they are not those of a model file, s, rad, N m
      and rad/s; and `guessed`: for which fields it is the content that says so, not the header.
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
    units: dict[str, tuple[str, ...]]
    guessed: tuple[str, ...]


def draft(columns: Mapping[str, np.ndarray], given: Mapping[str, Sequence[str] | None] | None = None) -> Draft:
    """What the columns (T,) of a log are taken for, by their names and, where these say nothing, by their content.

    - `given`: names for t, q, u or v that are known and not guessed.

    Raises `ValueError`, one line that says which columns were seen, where it is not clear which are the stamps, the
    positions or the inputs.
    """
    given = {key: tuple(names) for key, names in (given or {}).items() if names is not None}
    for name in [name for names in given.values() for name in names]:
        if name not in columns:
            raise ValueError(f"there is no column {name!r} of numbers{_columns_there(columns)}")
    fixed = {name for names in given.values() for name in names}
    kinds = {name: _kind(name) for name in columns if name not in fixed}
    t = given["t"][0] if "t" in given else _stamps(columns, kinds)
    step = _step(t, columns[t])
    q = given.get("q") or tuple(name for name, kind in kinds.items() if kind == "q" and name != t)
    if not q:
        raise ValueError(
            f"no column is named like a position, as q1 or theta; name them by --q{_columns_there(columns)}"
        )
    _one_family("q", q, given, columns)
    u = given.get("u") or tuple(name for name, kind in kinds.items() if kind == "u")
    _one_family("u", u, given, columns)
    if len(u) > len(q):
        raise ValueError(
            f"{len(u)} inputs ({', '.join(u)}) for {len(q)} positions; name them by --u{_columns_there(columns)}"
        )
    v = given.get("v") or tuple(name for name, kind in kinds.items() if kind == "v")
    if not v:
        unknown = [name for name, kind in kinds.items() if kind == "" and name != t]
        v = tuple(name for p in q for name in unknown if _is_slope(columns[t], columns[p], columns[name]))
    v = v if len(v) == len(q) else ()
    logged = np.column_stack([columns[name] for name in q])
    if np.isnan(logged[0]).any():
        raise ValueError(f"row 1 lacks a position ({', '.join(q)}); cut the log to begin later")
    span = np.stack([np.nanmin(logged, axis=0), np.nanmax(logged, axis=0)], axis=1)
    units, guessed = _units({"t": (t,), "q": q, "u": u, "v": v}, step, span)
    seconds = unit_factor(units.get("t", ("s",))[0])
    y = logged * [unit_factor(text) for text in units.get("q", ("rad",) * len(q))]
    return Draft(
        t,
        q,
        u,
        v,
        tuple(name for name in columns if name not in (t, *q, *u, *v)),
        1 / (step * seconds),
        len(y),
        _tick(y),
        float(np.sqrt(np.nanmean(np.diff(y, 3, axis=0) ** 2) / 20)) if len(y) > 4 else 0.0,
        span,
        units,
        guessed,
    )


def _units(
    fields: Mapping[str, tuple[str, ...]], step: float, span: Float[np.ndarray, "n 2"]
) -> tuple[dict[str, tuple[str, ...]], tuple[str, ...]]:
    """The units of the columns of each field, where they are not those of a model file; and which are guessed.

    - `step`: the median step of the stamps, `span` (n, 2) of the positions, as logged.
    """
    told = {field: [_unit_in(name, _MEANT[field]) for name in names] for field, names in fields.items()}
    content = {"t": next(unit for most, unit in CLOCKS if step < most)}
    content["q"] = "deg" if np.max(np.ptp(span, axis=1)) > DEGREES else "rad"
    found, guessed = {}, []
    for field, given in told.items():
        if None in given and field in content:
            guessed.append(field)
        texts = tuple(text or content.get(field, _MEANT[field]) for text in given)
        if any(unit_factor(text) != unit_factor(_MEANT[field]) for text in texts):
            found[field] = texts
    return found, tuple(field for field in guessed if field in found)


def _unit_in(name: str, meant: str) -> str | None:
    """The unit that the name of a column ends with, where it is of the kind that is meant."""
    match = _IN_NAME.search(name)
    if match is None:
        return None
    text = match[1] or match[2]
    text = _PLAIN.get(text, text)
    try:
        check_unit(text, meant)
    except ValueError:
        return None
    return None if re.fullmatch(r"[-+.0-9e]*", text) else text  # q(1) is a name


def _columns_there(columns: Mapping[str, np.ndarray]) -> str:
    return f"; the columns of numbers are {', '.join(columns) or 'none'}"


def _kind(name: str) -> str:
    """What a name is taken for, a key of `_WORDS`; empty where it says nothing."""
    if _unit_in(name, "rad/s"):
        return "v"
    words = set(re.findall(r"[a-z]+", name.lower()))
    return next((kind for kind, known in _WORDS.items() if words & set(known.split())), "")


def _stamps(columns: Mapping[str, np.ndarray], kinds: Mapping[str, str]) -> str:
    rising = [name for name, values in columns.items() if np.isfinite(values).all() and (np.diff(values) > 0).all()]
    named = [name for name in rising if kinds.get(name) == "t"]
    found = named or [name for name in rising if kinds.get(name) == ""]
    if len(found) == 1:
        return found[0]
    what = f"{', '.join(found)} all rise from row to row" if found else "no column of stamps rises from row to row"
    raise ValueError(f"{what}; name the one of the stamps by --t{_columns_there(columns)}")


def _step(name: str, t: np.ndarray) -> float:
    """The median step of the stamps; raises `ValueError` where they do not rise."""
    if len(t) < 2 or not (np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise ValueError(f"the stamps {name} do not rise from row to row; sort the log, or name others by --t")
    return float(np.median(np.diff(t)))


def _one_family(key: str, names: Sequence[str], given: Mapping[str, Sequence[str]], columns) -> None:
    """Raise `ValueError` where names such as q1, q2 and th1, th2 say that there are several kinds of them."""
    stems = {re.sub(r"[0-9]+", "#", name) for name in names}
    if key not in given and 1 < len(stems) < len(names):
        raise ValueError(
            f"{', '.join(names)} may all be {key}; name those that are by --{key}{_columns_there(columns)}"
        )


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
