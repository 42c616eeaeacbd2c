"""Measurements that are predicted some rows ahead, from the estimates of a run: a judge that needs no reference.

What a velocity is worth shows in what the model makes of it. A measurement that is still to come has no part in the
estimate, so the error of its prediction is that of the estimate, moved ahead, and an independent one of the sensor.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant.calibration.identification._error_model import LONGEST_GAP
from covariant.models import MechanicalSystem, Motion, advance
from covariant.signals import Record

HORIZON, LONGEST_HORIZON = 1.5, 50
"""Horizon of predictions, in units of 1/ω of the observer, and its largest number of rows. Over a much shorter time the
position alone decides, over a longer one the error of the model."""
MOST_STARTS = 1000
"""Largest number of rows of a log from which the motion is predicted."""
FAR = 16.0
"""Cap on squared errors, as a multiple of their 90 % quantile: an outlier decides nothing."""


def rows_ahead(rate: float, frequency: float) -> int:
    """Number of rows over which predictions tell what the velocity of an estimate is worth.

    Args:
        rate: Sampling rate [Hz].
        frequency: Natural frequency ω [rad/s] of the observer, or of one like it.

    Returns:
        The rows in `HORIZON`/ω, at least 2 and at most `LONGEST_HORIZON`.

    Example:
        >>> from covariant.calibration import rows_ahead
        >>> rows_ahead(rate=200.0, frequency=30.0)
        10
    """
    return int(np.clip(np.ceil(HORIZON * rate / frequency), 2, LONGEST_HORIZON))


def errors_ahead(
    model: MechanicalSystem,
    record: Record,
    motion: Motion,
    rows: Bool[np.ndarray, "T"],
    horizon: int,
    substeps: int | None = None,
) -> Float[np.ndarray, "K h n"]:
    """Errors of measurements predicted from estimates, one to h rows ahead.

    Args:
        model: The mechanical system that predicts.
        record: The log, of T rows.
        motion: Estimated configurations and velocities (T, n) after each row.
        rows: Rows (T,) of which the measurements are predicted; at most `MOST_STARTS` of them, evenly.
        horizon: Number h of rows.
        substeps: Runge–Kutta steps in each sample; by default none is longer than 10 ms.

    Returns:
        Measured minus predicted configurations (K, h, n) in the frame; NaN where missing, or beyond a gap,
        and infinite where the estimate or the prediction is not finite.

    Raises:
        ValueError: No row is followed by h others of the selection.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.calibration import errors_ahead
        >>> from covariant.models import Motion, oscillator
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 4.0, 0.02)
        >>> record = Record(t, np.zeros((200, 1)), np.cos(t)[:, None])
        >>> true = Motion(jnp.cos(t)[:, None], -jnp.sin(t)[:, None])
        >>> errors = errors_ahead(oscillator(), record, true, t > 2.0, horizon=5)
        >>> errors.shape[1:], bool(np.abs(errors).max() < 1e-8)
        ((5, 1), True)
    """
    t = np.asarray(record.t)
    starts = np.flatnonzero(rows[horizon:])  # those whose last target is in the selection
    starts = starts[rows[starts + 1]]
    if not len(starts):
        raise ValueError(f"errors_ahead: no row is followed by {horizon} others among the {rows.sum()} selected")
    starts = starts[:: -(-len(starts) // MOST_STARTS)]
    usual = float(np.median(np.diff(t)))
    steps = substeps or int(np.clip(np.ceil(usual / 0.01 - 1e-9), 1, 100))
    data = [jnp.asarray(np.asarray(each)) for each in (t, record.u, record.y)]
    errors = np.asarray(_errors(model, data, jax.tree.map(jnp.asarray, motion), jnp.asarray(starts), horizon, steps))
    gaps = np.cumsum(np.concatenate([[0], np.diff(t) > LONGEST_GAP * usual]))
    broken = gaps[starts[:, None] + 1 + np.arange(horizon)] > gaps[starts, None]
    return np.where(broken[..., None], np.nan, errors)


@eqx.filter_jit
def _errors(model: MechanicalSystem, data: Any, motion: Motion, starts: Array, horizon: int, substeps: int) -> Array:
    t, u, y = data

    def ahead(k):
        def step(now, j):
            after = advance(model, t[j], now, u[j], t[j + 1] - t[j], substeps)
            error = model.manifold.towards(after.q, y[j + 1])
            error = jnp.where(jnp.isfinite(error), error, jnp.inf)
            return after, jnp.where(model.manifold.missing(y[j + 1]), jnp.nan, error)

        return jax.lax.scan(step, Motion(motion.q[k], motion.v[k]), k + jnp.arange(horizon))[1]

    return jax.vmap(ahead)(starts)


def size(errors: Sequence[Float[np.ndarray, "_ _ n"]]) -> Float[np.ndarray, "n"]:
    """Root mean squares of errors, which outliers do not decide."""
    columns = np.concatenate([np.reshape(each, (-1, each.shape[-1])) for each in errors]).T
    return np.sqrt([mean_square(column[~np.isnan(column)]) for column in columns])


def mean_square(r: np.ndarray) -> float:
    """Mean square of errors, robust to outliers; infinite where one is not finite, or there is none."""
    if not r.size or not np.isfinite(r).all():
        return float("inf")
    square = r**2
    return float(np.mean(np.minimum(square, FAR * np.quantile(square, 0.9))))
