"""Usual speed of a machine in a log, robust to wrong measurements."""

import jax
import jax.numpy as jnp
import numpy as np

from covariant.models import MechanicalSystem
from covariant.signals import Record

TOGETHER = 5
"""Number of neighbouring speeds of which the median is taken: one wrong measurement spoils two."""
USUAL = 0.99
"""Quantile of these medians: high, since a log may stand still for a long time."""


def usual_speeds(model: MechanicalSystem, record: Record) -> tuple[float, ...]:
    """Usual size of each velocity in a record, from differences of neighbouring positions.

    Args:
        model: The mechanical system, whose manifold says which coordinates are angles.
        record: The log; measurements may be missing or wrong.

    Returns:
        The speeds (n,) [rad/s or m/s]; zero where too little was measured.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import usual_speeds
        >>> from covariant.models import oscillator
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 5.0, 0.01)
        >>> speeds = usual_speeds(oscillator(), Record(t, y=0.5 * np.sin(2 * t)[:, None]))
        >>> [round(speed, 2) for speed in speeds]
        [1.0]
    """
    t, y, manifold = np.asarray(record.t), np.asarray(record.y), model.manifold
    if manifold.commuting:
        columns = [(t[seen], column[seen, None]) for column in y.T for seen in (np.isfinite(column),)]
        circles = manifold.circles
        speeds = [np.abs(_wrapped(np.diff(q[:, 0]), i in circles) / np.diff(s)) for i, (s, q) in enumerate(columns)]
        return tuple(_usual(rates) for rates in speeds)
    complete = np.isfinite(y).reshape(len(t), -1).all(axis=1)
    displacement = jax.jit(jax.vmap(manifold.local))(jnp.asarray(y[complete][:-1]), jnp.asarray(y[complete][1:]))
    rates = np.abs(np.asarray(displacement)) / np.diff(t[complete])[:, None]
    return tuple(_usual(column) for column in rates.T)


def _wrapped(change: np.ndarray, circle: bool) -> np.ndarray:
    # Onto [−π, π): a step of more than half a turn is one the other way.
    return (change + np.pi) % (2 * np.pi) - np.pi if circle else change


def _usual(rates: np.ndarray) -> float:
    if len(rates) < TOGETHER:
        return 0.0
    medians = np.median(np.lib.stride_tricks.sliding_window_view(rates, TOGETHER), axis=1)
    return float(np.quantile(medians, USUAL))
