"""Commands of servos among the columns of a log: which ones positions follow, how late, in which unit."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs import words_of

LATEST = 0.3
"""Longest time [s] by which a position follows a command."""
LAG_STEP = 0.01
"""Distance [s] of the lags that are compared."""
MOST_ROWS = 3000
"""Number of rows at which positions and commands are compared."""
TRIMMED = 0.8
"""Fraction of the rows that count: a servo that lets go, or stands at its limit, does not follow for a while."""
FOLLOWS = 0.3
"""Largest error, as a fraction of the motion, with which a position follows a column that is named as a command."""
FOLLOWS_CLOSELY = 0.15
"""The same of a column whose name says nothing."""
LATE = 2.0
"""How much larger that error is without a lag, for a column whose name says nothing."""
COPIED = 0.95
"""Fraction of the rows in which a copy of the positions equals them."""
SAME = 0.95
"""Least correlation of a column with the slope of a position for it to count as a velocity."""
FEWEST_CHANGES = 10
"""Fewest rows in which a position changes, for it to show anything."""
POSITIONS = words_of("q th theta angle ang angles pos position positions enc encoder")
"""Words that make a position of what else names a motor, an input, or what is measured now: motor_angle."""
TORQUES = words_of("tau torque torques tq trq effort force forces moment moments")
"""Words of torques and forces."""
TARGETS = words_of("ref reference references desired goal goals target targets set setpoint setpoints")
"""Words of commands that are never those of torques."""
COMMANDS = TARGETS | words_of(
    "cmd cmds command commands commanded action actions des leader sp demand demanded qdes qref qcmd posdes poscmd"
)
"""Words of commands."""
ROLE_WORDS = (
    POSITIONS
    | COMMANDS
    | words_of("joint observation state present actual act measured meas current curr fb feedback follower d")
)
"""Words that names of a position and of its command do not share."""


class Following(NamedTuple):
    """How a position follows a command: `q(t) ≈ slope (c(t − lag) − command) + position`, in the numbers of the log.

    Attributes:
        error: Error of that, as a fraction of the motion; the worst fifth of the rows does not count.
        slope: Change of the position for one of the command.
        position, command: Means of both, where they count.
        whole: Error with the worst rows, too.
        lag: Lag [s].
        late: Error without a lag, or with a command after the position, in this error.
    """

    error: float
    slope: float
    position: float
    command: float
    whole: float
    lag: float = 0.0
    late: float = 1.0

    @property
    def is_close(self) -> bool:
        """Whether this alone shows a command: the position follows closely, with a lag and a slope near 1."""
        closely = self.error < FOLLOWS_CLOSELY and self.late > LATE
        return closely and self.lag > 0 and 0.7 < abs(self.slope) < 1.3


def follows(fit: Following | None) -> bool:
    """Whether a position follows a column that is named as a command."""
    return fit is not None and fit.error < FOLLOWS


def follow(
    t: Float[np.ndarray, "T"], q: Float[np.ndarray, "T"], c: Float[np.ndarray, "T"], on: np.ndarray | None = None
) -> Following | None:
    """Regression of a position on a command at lags from 0 to `LATEST`; None where either stands still.

    `t` are seconds; `on` (T,) are the rows in which the servo is switched on, all by default.
    """
    valid = np.isfinite(q) & np.isfinite(c) & (True if on is None else on)
    if np.count_nonzero(np.diff(q[valid])) < FEWEST_CHANGES or not np.diff(c[valid]).any():
        return None
    rows = np.flatnonzero(valid)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_ROWS).astype(int))]
    given = np.isfinite(c)

    def fitted(lag: float) -> Following:
        inside = rows[(t[rows] - lag >= t[0]) & (t[rows] - lag <= t[-1])]
        line = _regression(np.interp(t[inside] - lag, t[given], c[given]), q[inside])
        return line._replace(lag=float(lag))

    fits = [fitted(lag) for lag in np.arange(0.0, LATEST + LAG_STEP / 2, LAG_STEP)]
    best = min(fits, key=lambda each: each.error)
    early = min(fits[0].error, *(fitted(-each).error for each in (0.02, 0.05, 0.1)))
    return best._replace(late=early / max(best.error, 1e-12))


def _regression(x: np.ndarray, y: np.ndarray) -> Following:
    """The line through y over x, without the worst rows."""
    kept, slope, centre, middle = np.ones(len(x), bool), 0.0, 0.0, 0.0
    errors = np.zeros(len(x))
    for _ in range(3):
        if np.count_nonzero(kept) < FEWEST_CHANGES or np.ptp(x[kept]) == 0:
            return Following(np.inf, slope, centre, middle, np.inf)
        centre, middle = float(y[kept].mean()), float(x[kept].mean())
        about = x[kept] - middle
        slope = float(about @ y[kept] / (about @ about))
        errors = y - centre - slope * (x - middle)
        kept = np.abs(errors) <= np.quantile(np.abs(errors), TRIMMED)
    motion = max(float(np.std(y)), 1e-300)
    return Following(float(np.std(errors[kept])) / motion, slope, centre, middle, float(np.std(errors)) / motion)


def stem(name: str) -> frozenset[str]:
    """What a name says beside the role of the column: `rotation` of `q_rotation` and `cmd_rotation`."""
    return frozenset(re.findall(r"[a-z]+|[0-9]+", name.lower())) - ROLE_WORDS


def pairs_by_name(names: Sequence[str], others: Sequence[str]) -> tuple[str | None, ...]:
    """For each name the one of the others with the same stem, or None; empty where that says nothing."""
    stems = [stem(other) for other in others]
    by_stem = [others[stems.index(stem(name))] if stems.count(stem(name)) == 1 else None for name in names]
    found = [name for name in by_stem if name is not None]
    return tuple(by_stem) if found and len(set(found)) == len(found) else ()


def pairs(names: Sequence[str], others: Sequence[str]) -> tuple[str | None, ...]:
    """For each name the one of the others with the same stem; by their order where stems do not say it.

    None where neither does, or where there is no other one left.
    """
    by_name = pairs_by_name(names, others)
    if by_name:
        return by_name
    return tuple(others) if len(others) == len(names) else (None,) * len(names)


def copied(q: Float[np.ndarray, "T"], c: Float[np.ndarray, "T"]) -> int | None:
    """By how many rows a command is a copy of its position, 0 or 1; None where it is none."""
    for rows in (0, 1):
        later, command = q[rows:], c[: len(c) - rows]
        moving = np.flatnonzero(np.diff(later) != 0) + 1
        if len(moving) >= FEWEST_CHANGES and np.mean(later[moving] == command[moving]) >= COPIED:
            return rows
    return None
