"""A gate for observers that know nothing of their own accuracy: constant gains, and filters without a model.

What a constant gain makes of an error is published law and stays as it is: an observer may start far from the truth,
and its innovations are then large for a while. The gate looks at what was measured alone. With the innovation r before
a correction and `e` the error that the correction left behind, both from the estimate to the measurement,

    d = r − e

is what the measurement says that the one before did not: noise, and the error of the velocity times the step, whatever
the gains and however large the error is. It is refused where neither the noise s of a sample nor a velocity explains
it, `d² > 2(ks)² + (cS dt)²`, with k the deviations of the gate, S the usual speed of the motion and c between 4 at the
start and 2 once smaller ones have been seen. An outlier that passes is no more than a velocity of cS over one step.

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
    Held,
    as_gain,
    check_positive,
    no_input,
)
from covariant.signals import Result

CREDIBLE = 4.0
"""Largest velocity, in usual ones, that a measurement may show anew; half of it once smaller ones have been seen."""


class GatedState(NamedTuple):
    """The state `inner` of the observer, at time t [s].

    - `left` (n,): error that the last correction left behind, from the estimate to the measurement.
    - `idle` (n,): time since the last measurement that was used [s].
    - `refused` (n,), `scale` (n,): what the gate remembers; see `Gate.judge`.
    - `slip` (n,): average of d², as a part of that of an estimate which is astray.
    - `held`: the last finite input.
    - `dt`: length of the last prediction [s].
    """

    inner: Any
    t: Scalar
    left: Vector
    idle: Vector
    refused: Int[Array, "n"]
    scale: Vector
    slip: Vector
    held: Held = None
    dt: Scalar | None = None


class Gated(AbstractObserver):
    """An observer whose measurements pass a gate first, and which says when its velocity is off.

    - `observer`: the observer of a mechanical system, or a filter of its coordinates.
    - `model`: the system, whose configurations are measured.
    - `noise`: standard deviation of the noise of one sample [rad or m].
    - `speed`: usual size of the velocities [rad/s or m/s]. Both are numbers, or arrays (n,).
    - `gate`: see `Gate`.

    A measurement that is refused counts as missing, and `result` says `OUTLIER`. After `gate.patience` of them in a row
    the estimate starts anew from the measured configuration, and `result` says `RESTARTED`; a velocity that the state
    of the observer holds as `v` is kept, unless it is not credible. Where the velocity is off by more than twice the
    usual one, as far as measurements tell, `result` says `ASTRAY`. Raises `ValueError` for numbers that are not
    positive.

    The state of the observer is `state.inner`.
    """

    observer: AbstractObserver
    model: MechanicalSystem
    noise: Scalar | Vector = eqx.field(converter=as_gain)
    speed: Scalar | Vector = eqx.field(converter=as_gain)
    gate: Gate = Gate()

    def __check_init__(self):
        check_positive("Gated", noise=self.noise, speed=self.speed)

    def init(self, y: Array, t: Number = 0.0) -> GatedState:
        rest = self.model.manifold.zero(y)
        inner = _not_holding(self.observer.init(y, t))
        held = no_input(self.model, rest)
        t = jnp.asarray(t, rest.dtype)
        return GatedState(inner, t, rest, rest, *open_gate(rest), rest, held, jnp.zeros_like(t))

    def estimate(self, state: GatedState) -> Any:
        return self.observer.estimate(state.inner)

    def predict(self, state: GatedState, u: Float[Array, "m"], dt: Scalar) -> GatedState:
        inner = self.observer.predict(state.inner, u, dt)
        return state._replace(inner=inner, t=state.t + dt, idle=state.idle + dt, dt=dt)

    def correct(self, state: GatedState, u: Float[Array, "m"], y: Array) -> tuple[GatedState, Any]:
        manifold = self.model.manifold
        present, innovation = ~manifold.missing(y), self.innovation(state, u, y)
        verdict = self._judge(state, innovation, present)
        inner, info = self.observer.correct(state.inner, u, self._without(y, verdict.far))
        used = present & ~verdict.far
        motion = self.model.motion(self.observer.estimate(inner))
        error = manifold.towards(motion.q, y)
        slip = self._slip(state, innovation, used)
        new = state._replace(
            inner=inner,
            left=jnp.where(used, error, state.left),
            idle=jnp.where(present, 0.0, state.idle),
            refused=verdict.refused,
            scale=verdict.scale,
            slip=slip,
        )
        # What was learnt of the measurements still holds where it widens the gate.
        fresh = self._restarted(state, motion, y)
        fresh = fresh._replace(scale=jnp.maximum(verdict.scale, 1.0))
        new = jax.tree.map(lambda a, b: jnp.where(verdict.restart, a, b), fresh, new)
        astray = jnp.any(slip > 1).astype(jnp.int32) * int(Result.ASTRAY)
        result = jnp.maximum(jnp.maximum(info.result, verdict.result(info.result)), astray)
        return new, info._replace(innovation=innovation, result=result.astype(info.result.dtype))

    def innovation(self, state: GatedState, u: Float[Array, "m"], y: Array) -> Vector:
        return self.observer.innovation(state.inner, u, y)

    def _slip(self, state: GatedState, innovation: Vector, used: Array) -> Vector:
        most = 2 * (self.gate.deviations * self.noise) ** 2 + (CREDIBLE / 2 * self.speed * state.idle) ** 2
        change = (innovation - state.left) ** 2 / most - state.slip
        return state.slip + jnp.where(used, change, 0.0) / (1 + self.gate.patience)

    def _judge(self, state: GatedState, innovation: Vector, present: Array) -> Judged:
        """Whether the measurement is explained by noise and velocity; see the head of this file."""
        dt, fast = state.dt, CREDIBLE / self.gate.deviations * self.speed
        usual = 2 * self.noise**2 + (fast * dt) ** 2
        # An error of the velocity has acted since the last measurement, `idle` ago; half a step less is forgiven.
        least = (2 * self.noise**2 + (fast * (state.idle - dt / 2)) ** 2) / usual
        cov = jnp.diag(jnp.broadcast_to(usual, innovation.shape).astype(innovation.dtype))
        change = innovation - state.left
        return self.gate.judge(self.model.manifold, change, cov, present, state.refused, state.scale, least)

    def _without(self, y: Array, far: Array) -> Array:
        """The measurement with what is refused missing; of one that is not in coordinates all is."""
        return jnp.where(far if self.model.manifold.commuting else jnp.any(far), jnp.nan, y)

    def _restarted(self, state: GatedState, motion: Motion, y: Array) -> GatedState:
        """The state at the measured configuration, with the velocity of the estimate where that is credible."""
        fresh = self.init(self.model.manifold.measured(motion.q, y), state.t)._replace(held=state.held, dt=state.dt)
        if "v" not in fresh.inner._fields:
            return fresh
        credible = jnp.all(jnp.abs(motion.v) <= CREDIBLE * self.speed)
        return fresh._replace(inner=fresh.inner._replace(v=jnp.where(credible, motion.v, 0.0)))


def _not_holding(state: Any) -> Any:
    """The state of an observer inside, which gets sound inputs only."""
    return state._replace(held=None) if "held" in state._fields else state
