"""Predictions of a model over windows of a log, and their errors."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from covariant._typing import Number
from covariant.calibration.identification._ahead import mean_square
from covariant.calibration.identification._windows import Windows
from covariant.lowering import evaluate_batch
from covariant.models import MechanicalSystem, Motion, advance, friction

LONGEST_STEP = 0.01
"""Longest Runge–Kutta step [s] of a prediction."""
MOST_SUBSTEPS = 100


class PredictionErrors(NamedTuple):
    """Root mean square errors of predictions from measured positions and reference velocities.

    Squares are capped at a multiple of their 90 % quantile, so that an outlier decides nothing.

    Attributes:
        one_step: Errors (n,) of the positions after one step [units of the frame].
        position: Errors (n,) of the positions at all rows of the windows [units of the frame].
        velocity: Errors (n,) of the velocities at all rows, against the reference [the same units a second].

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import PredictionErrors
        >>> errors = PredictionErrors(one_step=np.array([1e-3]), position=np.array([0.02]), velocity=np.array([0.1]))
        >>> errors.position.tolist()
        [0.02]
    """

    one_step: Float[np.ndarray, "n"]
    position: Float[np.ndarray, "n"]
    velocity: Float[np.ndarray, "n"]


def lagged(inputs: Float[Array, "S m"], steps: Float[Array, "S"], lag: Number) -> Float[Array, "S m"]:
    """Inputs after a first-order lag, as in `signals.lag_inputs`."""
    if not isinstance(lag, Tracer) and float(lag) == 0:
        return inputs

    def step(previous, row):
        # Exact for an input that is constant over the step.
        decay = jnp.exp(-row[1] / lag)
        current = decay * previous + (1 - decay) * row[0]
        return current, current

    return jax.lax.scan(step, jnp.zeros_like(inputs[0]), (inputs, steps))[1]


def follow(
    model: MechanicalSystem, t: Float[Array, "L1"], u: Float[Array, "L m"], start: Motion, substeps: int
) -> Motion:
    """Predict the motion at given stamps, each input constant over its step."""

    def step(motion, row):
        begin, end, input_ = row
        after = advance(model, begin, motion, input_, end - begin, substeps)
        return after, after

    after = jax.lax.scan(step, start, (t[:-1], t[1:], u))[1]
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, after)


def differences(model: MechanicalSystem, q: Array, y: Array) -> tuple[Float[Array, "L1 n"], Bool[Array, "L1 n"]]:
    """Prediction errors of the configuration, in the frame."""
    manifold = model.manifold
    return jax.vmap(manifold.towards)(q, y), ~jax.vmap(manifold.missing)(y)


def needed_substeps(model: MechanicalSystem, windows: Windows) -> int:
    """Number of Runge–Kutta steps in one step of the log, none longer than 10 ms nor than 1/rate of the friction.

    The rate is bounded by the trace of the Jacobian of the friction at rest, where Coulomb friction is steepest, and at
    the largest velocities of the log.
    """
    t, y, v, rows, inputs = (np.asarray(a) for a in (windows.t, windows.y, windows.v, windows.rows, windows.inputs))
    longest = float(np.diff(t, axis=1).max())
    fastest = np.abs(v).max(axis=(0, 1))

    def rate(t, q, v, u):
        return -jnp.trace(jax.jacfwd(lambda w: friction(model, t, q, w, u))(v))

    sampled = np.arange(0, len(y), max(1, len(y) // 8))
    speeds = np.repeat([np.zeros_like(fastest), fastest], len(sampled), axis=0)
    sampled = np.tile(sampled, 2)
    rates = evaluate_batch(rate, t[sampled, 0], y[sampled, 0], speeds, inputs[rows[sampled, 0]])
    # At h · rate ≤ 1 the Runge–Kutta method, stable on the real axis down to −2.78, has a margin.
    needed = longest * max(1 / LONGEST_STEP, np.nanmax(rates))
    return int(np.clip(np.ceil(needed), 1, MOST_SUBSTEPS))


def prediction_errors(model: MechanicalSystem, lag: Number, windows: Windows) -> PredictionErrors:
    """Errors of a model's predictions against the positions and reference velocities of a log.

    Args:
        model: The mechanical system.
        lag: Time constant [s] of the first-order lag of the inputs; 0 for none.
        windows: The windows of the log.

    Returns:
        Root mean square errors after one step and over whole windows, of which outliers decide nothing.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import prediction_errors, cut_windows
        >>> from covariant.models import oscillator
        >>> from covariant.signals import Record
        >>> t = np.arange(0.0, 10.0, 0.02)
        >>> record = Record(t, np.zeros((500, 1)), np.cos(t)[:, None])
        >>> errors = prediction_errors(oscillator(), 0.0, cut_windows([record], [-np.sin(t)[:, None]], length=1.0))
        >>> bool(errors.position[0] < 1e-9)
        True
    """
    substeps = needed_substeps(model, windows)
    u = np.asarray(lagged(jnp.asarray(windows.inputs), jnp.asarray(windows.steps), lag))[np.asarray(windows.rows)]
    data = (windows.t, u, windows.y, windows.v)
    errors = _errors(model, jax.tree.map(jnp.asarray, data), substeps)
    single, whole, speed, seen, timed = jax.tree.map(np.asarray, errors)

    def rms(errors, mask):
        columns = [errors[..., i][mask[..., i]] for i in range(errors.shape[-1])]
        return np.sqrt([mean_square(column) if column.size else 0.0 for column in columns])

    # The prediction starts from the first row, whose error is zero by construction.
    later = seen & (np.arange(seen.shape[1]) > 0)[:, None]
    return PredictionErrors(rms(single, later[:, 1:] & seen[:, :-1]), rms(whole, later), rms(speed, timed))


@eqx.filter_jit
def _errors(model: MechanicalSystem, data: Any, substeps: int):
    manifold = model.manifold

    def window(t, u, y, v):
        def step(predicted, row):
            begin, end, input_, q, w = row
            present = manifold.measured(predicted.q, q)  # where something is missing its error is masked
            # Two motions in one: advanced apart, the model would be compiled twice.
            both = jax.tree.map(lambda *parts: jnp.stack(parts), predicted, Motion(present, w))
            both = jax.vmap(lambda motion: advance(model, begin, motion, input_, end - begin, substeps))(both)
            after, once = (jax.tree.map(lambda part, k=k: part[k], both) for k in range(2))
            return after, (after, once.q)

        start = Motion(y[0], v[0])
        after, once = jax.lax.scan(step, start, (t[:-1], t[1:], u, y[:-1], v[:-1]))[1]
        predicted = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, after)
        whole, seen = differences(model, predicted.q, y)
        single, _ = differences(model, once, y[1:])
        timed = jnp.concatenate([jnp.ones(1, bool), jnp.diff(t) > 0])[:, None]
        return single, whole, v - predicted.v, seen, timed & jnp.ones_like(seen)

    return jax.vmap(window)(*data)
