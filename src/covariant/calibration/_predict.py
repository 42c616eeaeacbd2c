"""What a model predicts over windows of a log, and by how much the log differs from it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from covariant._typing import Number
from covariant.calibration._windows import Windows
from covariant.models import MechanicalSystem, Motion, advance, friction

LONGEST_STEP = 0.01
"""Longest Runge–Kutta step [s] of a prediction."""
MOST_SUBSTEPS = 100


class PredictionErrors(NamedTuple):
    """Root mean square errors of predictions that start from measured positions and reference velocities.

    - `one_step`, `position` (n,): of the positions after one step, and at all rows of the windows [units of the frame].
    - `velocity` (n,): of the velocities at all rows of the windows, against the reference [the same units a second].
    """

    one_step: Float[Array, "n"]
    position: Float[Array, "n"]
    velocity: Float[Array, "n"]


def lagged(inputs: Float[Array, "S m"], steps: Float[Array, "S"], lag: Number) -> Float[Array, "S m"]:
    """Inputs behind a first-order lag [s], as `signals.lag_inputs` has them; the lag may be traced by JAX."""
    if not isinstance(lag, Tracer) and float(lag) == 0:
        return inputs

    def step(before, row):
        keep = jnp.exp(-row[1] / lag)
        now = keep * before + (1 - keep) * row[0]
        return now, now

    return jax.lax.scan(step, jnp.zeros_like(inputs[0]), (inputs, steps))[1]


def follow(
    model: MechanicalSystem, t: Float[Array, "L1"], u: Float[Array, "L m"], start: Motion, substeps: int
) -> Motion:
    """The motion at the stamps t (L + 1,) [s] that begins with `start`, each input held over its step."""

    def step(now, row):
        begin, end, held = row
        after = advance(model, begin, now, held, end - begin, substeps)
        return after, after

    after = jax.lax.scan(step, start, (t[:-1], t[1:], u))[1]
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, after)


def differences(model: MechanicalSystem, q: Array, y: Array) -> tuple[Float[Array, "L1 n"], Bool[Array, "L1 n"]]:
    """What is measured minus what is predicted, in the frame, zero where it is missing; and where it is measured."""
    manifold = model.manifold
    return jax.vmap(manifold.towards)(q, y), ~jax.vmap(manifold.missing)(y)


def needed_substeps(model: MechanicalSystem, windows: Windows) -> int:
    """Runge–Kutta steps in one step of the log, so that none is longer than 10 ms nor than 1/rate of the friction.

    The rate is bounded by the trace of the Jacobian of the friction at rest, where Coulomb friction is steepest, and
    at the largest velocities of the log.
    """
    y, v, rows = np.asarray(windows.y), np.asarray(windows.v), np.asarray(windows.rows)
    longest = float(np.diff(np.asarray(windows.t), axis=1).max())
    fastest = np.abs(v).max(axis=(0, 1))

    @eqx.filter_jit
    def rate(model, t, q, v, u):
        return -jnp.trace(jax.jacfwd(lambda w: friction(model, t, q, w, u))(v))

    some = range(0, len(y), max(1, len(y) // 8))
    rates = [
        float(rate(model, jnp.asarray(windows.t[k, 0]), jnp.asarray(y[k, 0]), jnp.asarray(at), windows.inputs[row]))
        for k in some
        for row in rows[k, :1]
        for at in (np.zeros_like(fastest), fastest)
    ]
    needed = longest * max(1 / LONGEST_STEP, np.nanmax(rates))
    return int(np.clip(np.ceil(needed), 1, MOST_SUBSTEPS))


def prediction_errors(model: MechanicalSystem, lag: Number, windows: Windows) -> PredictionErrors:
    """How far the predictions of a model are from the positions and reference velocities of a log.

    - `lag` [s]: of the inputs.
    """
    substeps = needed_substeps(model, windows)
    u = lagged(jnp.asarray(windows.inputs), jnp.asarray(windows.steps), lag)[jnp.asarray(windows.rows)]
    given = (jnp.asarray(windows.t), u, jnp.asarray(windows.y), jnp.asarray(windows.v))
    single, whole, speed, seen, timed = _errors(model, given, substeps)

    def rms(errors, mask):
        total, count = (jnp.sum(jnp.where(mask, part, 0.0), axis=(0, 1)) for part in (errors**2, jnp.ones_like(errors)))
        return jnp.sqrt(total / jnp.maximum(count, 1.0))

    later = seen.at[:, 0].set(False)
    return PredictionErrors(rms(single, later[:, 1:] & seen[:, :-1]), rms(whole, later), rms(speed, timed))


@eqx.filter_jit
def _errors(model: MechanicalSystem, given: Any, substeps: int):
    manifold = model.manifold

    def window(t, u, y, v):
        predicted = follow(model, t, u, Motion(y[0], v[0]), substeps)
        whole, seen = differences(model, predicted.q, y)
        present = jax.vmap(manifold.measured)(predicted.q, y)  # where something is missing its error is masked
        once = jax.vmap(lambda s, q, w, held, h: advance(model, s, Motion(q, w), held, h, substeps).q)
        single, _ = differences(model, once(t[:-1], present[:-1], v[:-1], u, jnp.diff(t)), y[1:])
        timed = jnp.concatenate([jnp.ones(1, bool), jnp.diff(t) > 0])[:, None]
        return single, whole, v - predicted.v, seen, timed & jnp.ones_like(seen)

    return jax.vmap(window)(*given)
