"""Chooses among many logs those that tell most of a machine, by the determinant of their information."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from covariant import scoring
from covariant.signals import Record

HALF_ROWS = 3.5
"""Half width, in rows, of the windows in which velocities and accelerations are found."""
MOVING = 0.1
"""Least speed that is motion, relative to the usual one."""
RIDGE = 1e-3
"""Information of the start, in rows of usual size, so that first choices are finite."""


def most_informative(records: Sequence[Record], rows: int) -> list[int]:
    """Indices of logs with this many rows in all, the one that adds most to the information of those before it first.

    The information is that of equations of motion which are linear in positions, velocities, their signs,
    accelerations and inputs, as a servo or a joint with friction has them. It counts by row, so that long logs are not
    preferred.

    Source: Fedorov 1972, Theory of optimal experiments: D-optimal designs, one log after the other.
    """
    motions = [_motion(record) for record in records]
    speed = np.sqrt(np.mean([np.nanmean(v**2, axis=0) for _, v, _ in motions], axis=0))
    tables = [_regressors(record, motion, speed) for record, motion in zip(records, motions, strict=True)]
    size = np.sqrt(np.mean([np.mean(table**2, axis=0) for table in tables], axis=0))
    used = size > 0
    scaled = [table[:, used] / size[used] for table in tables]
    matrices, counts = np.array([each.T @ each for each in scaled]), np.array([len(each) for each in scaled])
    known, chosen, left = RIDGE * np.eye(int(used.sum())), [], list(range(len(tables)))
    while left and counts[chosen].sum() < rows:
        gains = (np.linalg.slogdet(known + matrices[left])[1] - np.linalg.slogdet(known)[1]) / counts[left]
        chosen.append(left.pop(int(np.argmax(gains))))
        known = known + matrices[chosen[-1]]
    return chosen


def _motion(record: Record) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and accelerations (T, n)."""
    t, y = (np.asarray(part, float) for part in (record.t, record.y))
    half = HALF_ROWS * float(np.median(np.diff(t)))
    q, v, a = np.moveaxis(scoring.local_polynomials(t, y.reshape(len(t), -1), t, half, 2)[:, :3], 1, 0)
    return q, v, 2 * a


def _regressors(
    record: Record, motion: tuple[np.ndarray, np.ndarray, np.ndarray], speed: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "K p"]:
    """Terms of the equations of motion (K, p) in the rows that are known; dry friction has a sign beyond a part of the
    usual speed (n,) of all logs."""
    q, v, a = motion
    table = np.column_stack([np.ones(len(q)), q, v, np.sign(v) * (np.abs(v) > MOVING * speed), a, np.asarray(record.u)])
    return table[np.isfinite(table).all(axis=1)]
