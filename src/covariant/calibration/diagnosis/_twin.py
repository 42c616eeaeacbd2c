"""The residual that a faultless log of the same machine would have: its model, driven by the same inputs.

Smoothing is wrong about motions that are faster than its windows, and ticks hide slow ones. How much of the
accelerations a right model leaves for these reasons shows in a log that the model itself makes: from a state of the
smoothed log on, under the logged inputs, read by sensors with the same ticks and noise.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._smooth import Smooth
from covariant.models import MechanicalSystem, Motion, advance
from covariant.signals import Record

ROWS = 2048
"""Rows of the twin, so that one program serves all logs."""
STEP = 5e-4
"""Longest step of the integration [s], as long as no more than `MOST_STEPS` are needed between two rows."""
MOST_STEPS = 50


def twin(model: MechanicalSystem, log: Smooth, record: Record, ticks: Float[np.ndarray, "n"]) -> Record | None:
    """Simulate a log without faults that is like another one.

    Args:
        model: The mechanical system, in coordinates.
        log: The other log, smoothed.
        record: The other log as it was read, with the inputs that act in each step.
        ticks: Ticks (n,) of its encoders; 0 for a sensor with noise.

    Returns:
        The simulated log, of at most `ROWS` rows with the same stamps, inputs and missing cells; None where the model
        does not stay finite or the other log is too short.
    """
    used = np.flatnonzero(log.used)
    if not len(used):
        return None
    begin = int(np.searchsorted(np.asarray(record.t), log.t[used[0]]))
    t, u, y = (np.asarray(a, float)[begin : begin + ROWS] for a in record[:3])
    if len(t) < 2:
        return None
    at = int(np.argmin(np.abs(log.t - t[0])))
    missing = ROWS - len(t)
    steps = np.clip(np.ceil(np.median(np.diff(t)) / STEP), 1, MOST_STEPS).astype(int)
    q = _simulated(
        model,
        np.concatenate([t, np.full(missing, t[-1])]),
        np.concatenate([u, np.repeat(u[-1:], missing, axis=0)]),
        Motion(jnp.asarray(log.q[at]), jnp.asarray(log.v[at])),
        steps,
    )
    q = np.asarray(q)[: len(t)]
    if not np.isfinite(q).all():
        return None
    noisy = q + np.random.default_rng(0).normal(size=q.shape) * np.where(ticks > 0, 0.0, log.noise)
    size = np.where(ticks > 0, ticks, 1.0)
    read = np.where(ticks > 0, np.round(noisy / size) * size, noisy)
    return Record(t, u, np.where(np.isnan(y), np.nan, read))


@eqx.filter_jit
def _simulated(model, t, u, start, steps):
    def row(motion, item):
        begin, dt, u = item
        motion = advance(model, begin, motion, u, dt, steps)
        return motion, motion.q

    _, q = jax.lax.scan(row, start, (t[:-1], jnp.diff(t), u[:-1]))
    return jnp.concatenate([start.q[None], q])
