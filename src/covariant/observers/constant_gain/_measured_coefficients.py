"""Defines the high-gain observer with the coefficients at the measured configuration and with clipped speeds.

    q̂' = v̂ − αe,   v̂' = −Γ(y)(σ(v̂), σ(v̂)) + S(y, u) + friction(y, σ(v̂)) − βe,   e = q̂ − y,

with σ the clip of each velocity to its bound V. If the true speeds keep to V, then σ(v̂) − v = Sζ with ζ = v̂ − v and S
diagonal, 0 ≤ S ≤ 1, and exactly, for errors of any size,

    e' = ζ − αe,   ζ' = −βe − Γ(y)(σ(v̂) + v, Sζ).

Each coordinate is a linear channel, in which the last term is a disturbance that is linear in ζ with a bounded factor.
A small-gain condition over the coordinates therefore gives convergence from all first errors; see
`certificates.certify_globally`.

Between samples the acceleration is held that the model has at the last measurement and at the velocity estimated there,
so that a sample is a linear step of each coordinate, in which this acceleration is an input.

Source: an addition. Esfandiari & Khalil 1992, Output feedback stabilization of fully linearizable systems, Int. J.
Control 56(5), for high gain and saturation.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._domains import ABOVE_ZERO
from covariant._typing import Number, Scalar, Vector
from covariant.models import MechanicalSystem, acceleration
from covariant.observers.base import (
    AbstractMechanicalObserver,
    Info,
    LastInput,
    aged,
    as_gain,
    at_rest,
    check_free,
    check_positive,
    outcome,
    readability,
    sampled_gains,
    still,
    time_since_measurement,
)
from covariant.signals import StepCode
from scalargraph.errors import InputError


class MeasuredState(NamedTuple):
    """State of a `MeasuredCoefficients` observer.

    Attributes:
        q: Estimated coordinates (n,).
        v: Estimated velocity (n,), not clipped.
        t: Time [s] of the estimate.
        seen: Coordinates (n,) measured last, with turns of circles counted, at which the model is evaluated.
        held: Velocity (n,) estimated there, clipped.
        last_input: The last finite input (m,); None in continuous time.
        age: Time since the last measurement [s]; None in continuous time.
    """

    q: Vector
    v: Vector
    t: Scalar
    seen: Vector
    held: Vector
    last_input: LastInput = None
    age: Scalar | None = None


class MeasuredCoefficients(AbstractMechanicalObserver):
    """High-gain observer with the model at the measured configuration and clipped speeds; converges from anywhere.

    In the field it is a saturated high-gain observer with measured coefficients: `q̂' = v̂ − αe`,
    `v̂' = −Γ(y)(σ(v̂), σ(v̂)) + S(y, u) − βe`, e = q̂ − y. Gains above a bound that the model and the largest speeds
    give make it converge from all first errors of position and velocity: `certificates.certify_globally` computes and
    proves them. It needs neither geodesics nor curvature. In exchange it does not follow the model between samples:
    it holds the last acceleration, so that it needs samples that are dense compared with the motion.

    A result of `ASTRAY` says that an estimated velocity exceeds `speed`: normal after a start far away, and otherwise a
    sign that the machine is faster than stated. On a circle, turns are counted between measurements, which must be less
    than half a turn apart at the speeds stated; in continuous time the error is the shorter way round.

    Attributes:
        model: The mechanical system, in coordinates.
        alpha: Gain α [1/s], one number or (n,).
        beta: Gain β [1/s²], one number or (n,).
        speed: Bound V of the true velocities [unit/s], one number or (n,); infinite by default, without a clip.

    Raises:
        ValueError: A gain is not positive and finite, the speed is not positive, or the model is on a group or has
            closed loops.

    Example:
        A double pendulum is started 20 rad/s off.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> arm = models.pendulum_chain((1.0, 1.0), (0.5, 0.5))
        >>> observer = observers.MeasuredCoefficients(arm, alpha=70.0, beta=2500.0, speed=2.0)
        >>> state = observer.init(jnp.zeros(2))._replace(v=jnp.full(2, 20.0))
        >>> step, zero = jax.jit(observer.step), jnp.zeros(2)
        >>> for _ in range(500):
        ...     state, info = step(state, zero, zero, 0.001)  # it hangs at rest
        >>> bool(jnp.abs(state.v).max() < 1e-3)
        True
    """

    model: MechanicalSystem
    alpha: Scalar | Vector = eqx.field(converter=as_gain)
    beta: Scalar | Vector = eqx.field(converter=as_gain)
    speed: Scalar | Vector = eqx.field(default=float("inf"), converter=as_gain)

    def __check_init__(self):
        check_positive(type(self).__name__, alpha=self.alpha, beta=self.beta)
        ABOVE_ZERO.check(type(self).__name__, "speed", self.speed)
        check_free(type(self).__name__, self.model)
        if not self.model.manifold.commuting:
            raise InputError("MeasuredCoefficients: its errors are differences of coordinates, and a group has none")

    def init(self, y: Array, t: Number = 0.0) -> MeasuredState:
        q, v, t, last_input, age = at_rest(self.model, y, t)
        return MeasuredState(q, v, t, q, v, last_input, age)

    def clip(self, v: Vector) -> Vector:
        """Velocities clipped to the bounds, σ(v)."""
        return jnp.clip(v, -self.speed, self.speed).astype(v.dtype)

    def flow(self, t: Scalar, state: MeasuredState, u: Float[Array, "m"], y: Array) -> MeasuredState:
        q, v, _, seen, held, last_input, age = state
        e = -self.model.manifold.towards(q, y)
        v_dot = acceleration(self.model, t, self.model.manifold.measured(q, y), self.clip(v), u) - self.beta * e
        kept = still(seen), still(held), still(last_input), still(age)
        return MeasuredState(v - self.alpha * e, v_dot, jnp.ones_like(state.t), *kept)

    def predict(self, state: MeasuredState, u: Float[Array, "m"], dt: Scalar) -> MeasuredState:
        held = acceleration(self.model, state.t, state.seen, state.held, u)
        q = self.model.manifold.retract(state.q, dt * state.v + dt * dt / 2 * held)
        age = dt if state.age is None else state.age + dt
        return state._replace(q=q, v=state.v + dt * held, t=state.t + dt, age=age)

    def correct(self, state: MeasuredState, u: Float[Array, "m"], y: Array) -> tuple[MeasuredState, Info]:
        manifold = self.model.manifold
        # On a circle the turn is counted from measurement to measurement, so that an error may be many turns.
        near = state.seen + time_since_measurement(state) * state.held
        turned = near + manifold.towards(near, y)
        missing = manifold.missing(y)
        e = jnp.where(missing, 0.0, state.q - turned)
        part, rate = sampled_gains(self.alpha, self.beta, time_since_measurement(state))
        q, v = manifold.retract(state.q, -part * e), state.v - rate * e
        # A row without any measurement leaves the model where it was evaluated, and so its acceleration.
        lost = jnp.all(missing)
        seen = jnp.where(lost, state.seen, jnp.where(missing, state.q, turned))
        held = jnp.where(lost, state.held, self.clip(v))
        fast = jnp.where(jnp.any(jnp.abs(v) > self.speed), int(StepCode.ASTRAY), int(StepCode.OK))
        code = outcome(q, v, manifold.seen(state.q, y), jnp.maximum(readability(self.model, near, y), fast))
        info = Info(self.innovation(state, u, y), self.model.space.norm(state.q, e), code)
        return state._replace(q=q, v=v, seen=seen, held=held, age=aged(self.model, state, y)), info
