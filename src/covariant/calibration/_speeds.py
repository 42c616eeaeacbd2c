"""How fast a machine moves in a log, whatever is wrong with some of its measurements."""

import jax
import jax.numpy as jnp
import numpy as np

from covariant.models import MechanicalSystem
from covariant.signals import Record

TOGETHER = 5
"""Speeds of which the median is taken: a wrong measurement spoils two."""
USUAL = 0.99
"""Part of these medians that the usual speed is not below: a log may stand still for a long time."""


def usual_speeds(model: MechanicalSystem, record: Record) -> tuple[float, ...]:
    """The size (n,) of the velocities of a record, from differences of neighbouring positions [rad/s or m/s].

    Zero where too little was measured to tell.
    """
    t, y, manifold = np.asarray(record.t), np.asarray(record.y), model.manifold
    if manifold.commuting:
        columns = [(t[seen], column[seen, None]) for column in y.T for seen in (np.isfinite(column),)]
        circles = manifold.circles
        found = [np.abs(_wrapped(np.diff(q[:, 0]), i in circles) / np.diff(s)) for i, (s, q) in enumerate(columns)]
        return tuple(_usual(rates) for rates in found)
    whole = np.isfinite(y).reshape(len(t), -1).all(axis=1)
    moved = jax.jit(jax.vmap(manifold.local))(jnp.asarray(y[whole][:-1]), jnp.asarray(y[whole][1:]))
    rates = np.abs(np.asarray(moved)) / np.diff(t[whole])[:, None]
    return tuple(_usual(column) for column in rates.T)


def _wrapped(change: np.ndarray, circle: bool) -> np.ndarray:
    return (change + np.pi) % (2 * np.pi) - np.pi if circle else change


def _usual(rates: np.ndarray) -> float:
    if len(rates) < TOGETHER:
        return 0.0
    medians = np.median(np.lib.stride_tricks.sliding_window_view(rates, TOGETHER), axis=1)
    return float(np.quantile(medians, USUAL))
