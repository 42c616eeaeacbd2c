"""A gate for observers that have no covariance: constant gains, and filters without a model.

With constant gains, an observer may start far from the truth, and its innovations are then large for a while, without
any outlier. So the gate must not judge the innovations alone. With the innovation r before a correction and `e` the
error that the previous correction left behind, both from the estimate to the measurement,

    d = r − e

is what this measurement says that the previous one did not: noise, and the error of the velocity times the step,
for any gains and any size of the error. It is refused where neither the noise s of a sample nor a velocity
explains it, `d² > 2(ks)² + (cS dt)²`, with k the deviations of the gate, S the usual speed of the motion and c between
4 at the start and 2 once smaller ones have been seen. An outlier that passes is no more than a velocity of cS over one
step.

Where measurements agree with each other and not with the estimate, as after an observer has lost a spinning body, d
stays large: once its square is more than that of a velocity error of 2S on average, the estimate is `ASTRAY`.

Source: Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, section 5.4.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from covariant._typing import Number, Scalar, Vector
from covariant.models import MechanicalSystem, Motion
from covariant.observers._gate import Gate, Judged, open_gate
from covariant.observers._protocol import (
    AbstractObserver,
    LastInput,
    as_gain,
    check_positive,
    no_input,
    step_length,
)
from covariant.signals import Result

CREDIBLE = 4.0
"""Largest credible velocity, as a multiple of the usual speed; the gate halves it once smaller ones have been seen."""


class GatedState(NamedTuple):
    """State of a `Gated` observer.

    Attributes:
        inner: State of the observer behind the gate.
        t: Time [s] that it belongs to.
        left: Error (n,) that the last correction left behind, from the estimate to the measurement.
        idle: Time [s] since each component (n,) was last measured, refused or not.
        refused: Number (n,) of samples refused in a row; see `Gate.judge`.
        scale: Average (n,) of the ratio of actual to expected squares; see `Gate.judge`.
        slip: Average (n,) of d², relative to that of an estimate which is astray.
        last_input: The last finite input (m,).
        dt: Length of the last prediction [s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> model = models.oscillator()
        >>> observer = observers.Gated(observers.Copy(model, 2.0, 4.0), model, noise=1e-3, speed=1.0)
        >>> state = observer.init(jnp.array([0.5]))
        >>> state.inner.q.tolist(), state.refused.tolist()
        ([0.5], [0])
    """

    inner: Any
    t: Scalar
    left: Vector
    idle: Vector
    refused: Int[Array, "n"]
    scale: Vector
    slip: Vector
    last_input: LastInput = None
    dt: Scalar | None = None


class Gated(AbstractObserver):
    """An observer whose measurements pass a gate first, and which reports when its velocity is off.

    A measurement that is refused counts as missing, and `result` says `OUTLIER`. After `gate.patience` of them in a row
    the estimate starts anew from the measured configuration, and `result` says `RESTARTED`; a velocity that the state
    of the observer holds as `v` is kept, unless it is not credible. Where the velocity is off by more than twice the
    usual one, as far as measurements tell, `result` says `ASTRAY`.

    Attributes:
        observer: Observer of a mechanical system, or filter of its coordinates. Its state is `state.inner`.
        model: Mechanical system whose configurations are measured.
        noise: Standard deviation of the noise of one sample [rad or m], a number or (n,).
        speed: Usual size of the velocities [rad/s or m/s], a number or (n,).
        gate: The gate, by default `Gate()`.

    Raises:
        ValueError: `noise` or `speed` is not positive and finite.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from covariant import Result, models, observers
        >>> model = models.oscillator()
        >>> observer = observers.Gated(observers.Copy(model, 2.0, 4.0), model, noise=1e-3, speed=1.0)
        >>> state = observer.init(jnp.zeros(1))
        >>> state, info = jax.jit(observer.step)(state, jnp.zeros(1), jnp.array([5.0]), 0.01)
        >>> Result(int(info.result)).name, observer.estimate(state).tolist()
        ('OUTLIER', [0.0, 0.0])
    """

    observer: AbstractObserver
    model: MechanicalSystem
    noise: Scalar | Vector = eqx.field(converter=as_gain)
    speed: Scalar | Vector = eqx.field(converter=as_gain)
    gate: Gate = Gate()

    def __check_init__(self):
        check_positive("Gated", noise=self.noise, speed=self.speed)

    def init(self, y: Array, t: Number = 0.0) -> GatedState:
        """State at rest at a measured configuration, with an open gate.

        Args:
            y: First measurement, complete: coordinates (n,), or on a group a matrix (N, N).
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.
        """
        rest = self.model.manifold.zero(y)
        inner = _without_last_input(self.observer.init(y, t))
        last_input = no_input(self.model, rest)
        t = jnp.asarray(t, rest.dtype)
        return GatedState(inner, t, rest, rest, *open_gate(rest), rest, last_input, jnp.zeros_like(t))

    def estimate(self, state: GatedState) -> Any:
        return self.observer.estimate(state.inner)

    def predict(self, state: GatedState, u: Float[Array, "m"], dt: Scalar) -> GatedState:
        inner = self.observer.predict(state.inner, u, dt)
        return state._replace(inner=inner, t=state.t + dt, idle=state.idle + dt, dt=dt)

    def correct(self, state: GatedState, u: Float[Array, "m"], y: Array) -> tuple[GatedState, Any]:
        """Correct a predicted state by a measurement that passes the gate.

        Args:
            state: State that `predict` returned.
            u: Input (m,) that acted over the prediction.
            y: Measurement, NaN where missing.

        Returns:
            The corrected state, or the one of a new start, and the info of the inner observer, with the innovation
            before the gate and the result code of gate and observer.
        """
        manifold = self.model.manifold
        present, innovation = ~manifold.missing(y), self.innovation(state, u, y)
        verdict = self._judge(state, innovation, present)
        inner, info = self.observer.correct(state.inner, u, self._without_refused(y, verdict.far))
        used = present & ~verdict.far
        motion = self.model.motion(self.observer.estimate(inner))
        error = manifold.towards(motion.q, y)
        slip = self._average_slip(state, innovation, used)
        new = state._replace(
            inner=inner,
            left=jnp.where(used, error, state.left),
            idle=jnp.where(present, 0.0, state.idle),
            refused=verdict.refused,
            scale=verdict.scale,
            slip=slip,
        )
        # After a new start a scale above 1 still holds; a smaller one would make the gate too narrow.
        fresh = self._restarted(state, motion, y)
        fresh = fresh._replace(scale=jnp.maximum(verdict.scale, 1.0))
        new = jax.tree.map(lambda a, b: jnp.where(verdict.restart, a, b), fresh, new)
        astray = jnp.any(slip > 1).astype(jnp.int32) * int(Result.ASTRAY)
        result = jnp.maximum(jnp.maximum(info.result, verdict.result(info.result)), astray)
        return new, info._replace(innovation=innovation, result=result.astype(info.result.dtype))

    def innovation(self, state: GatedState, u: Float[Array, "m"], y: Array) -> Vector:
        return self.observer.innovation(state.inner, u, y)

    def _average_slip(self, state: GatedState, innovation: Vector, used: Array) -> Vector:
        limit = 2 * (self.gate.deviations * self.noise) ** 2 + (CREDIBLE / 2 * self.speed * state.idle) ** 2
        # Twice the variance: two samples contribute to the difference d.
        change = (innovation - state.left) ** 2 / limit - state.slip
        return state.slip + jnp.where(used, change, 0.0) / (1 + self.gate.patience)

    def _judge(self, state: GatedState, innovation: Vector, present: Array) -> Judged:
        """The gate's verdict on d: whether noise and velocity explain it; see the head of this file."""
        dt, rate = step_length(state), CREDIBLE / self.gate.deviations * self.speed
        expected = 2 * self.noise**2 + (rate * dt) ** 2
        # An error of the velocity has acted over a gap; readings that were refused do not widen the gate for the next.
        least = (2 * self.noise**2 + (rate * (state.idle - dt / 2)) ** 2) / expected
        cov = jnp.diag(jnp.broadcast_to(expected, innovation.shape).astype(innovation.dtype))
        change = innovation - state.left
        return self.gate.judge(self.model.manifold, change, cov, present, state.refused, state.scale, least)

    def _without_refused(self, y: Array, far: Array) -> Array:
        """The measurement with NaN for what is refused; one that is not in coordinates is missing as a whole."""
        return jnp.where(far if self.model.manifold.commuting else jnp.any(far), jnp.nan, y)

    def _restarted(self, state: GatedState, motion: Motion, y: Array) -> GatedState:
        """The state at the measured configuration, with the velocity of the estimate where that is credible."""
        fresh = self.init(self.model.manifold.measured(motion.q, y), state.t)
        fresh = fresh._replace(last_input=state.last_input, dt=state.dt)
        if "v" not in fresh.inner._fields:
            return fresh
        credible = jnp.all(jnp.abs(motion.v) <= CREDIBLE * self.speed)
        return fresh._replace(inner=fresh.inner._replace(v=jnp.where(credible, motion.v, 0.0)))


def _without_last_input(state: Any) -> Any:
    """State of the inner observer without a field for the last input: it gets valid inputs only."""
    return state._replace(last_input=None) if "last_input" in state._fields else state
