"""The exact intrinsic observer: geodesic error, parallel transport, curvature. It is the same in all coordinates.

Source: Aghannan & Rouchon 2003, equation (2), with the curvature sign of `covariant.geometry`; Maithripala, Berg &
Dayawansa 2004, equation (17), for groups.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._typing import Code, Flag, Number, Scalar, Vector
from covariant.geometry import Budget
from covariant.models import MechanicalSystem, Motion, friction, source
from covariant.observers._protocol import (
    AbstractMechanicalObserver,
    Held,
    aged,
    as_gain,
    at_rest,
    check_positive,
    outcome,
    still,
    uniqueness,
)
from covariant.observers._sampled import predicted, sampled_correction, worth
from covariant.signals import Result


class GeodesicState(NamedTuple):
    """Estimate (q, v) at time t [s], the last solution `log` = log_q(q̂), a velocity at the measurement q from which the
    next search starts, and what `HeldState` remembers between samples."""

    q: Inexact[Array, "..."]
    v: Vector
    t: Scalar
    log: Vector
    held: Held = None
    age: Scalar | None = None


class GeodesicInfo(NamedTuple):
    """As `Info`, where `distance` is the length of the geodesic, and `residual` the length in the metric by which it
    misses the measurement, infinite where no geodesic was found."""

    innovation: Vector
    distance: Scalar
    residual: Scalar
    result: Code


class _Correction(NamedTuple):
    log: Vector  # velocity at the estimate that leads to the measurement in unit time
    back: Vector  # and one at the measurement that leads to the estimate
    drive: Vector
    residual: Scalar
    result: Code
    exact: Flag  # whether it is along a geodesic that was found


class Geodesic(AbstractMechanicalObserver):
    """Observer (2) of Aghannan & Rouchon for any `MechanicalSystem`, with ξ = −log_q̂(q):

        q̂' = E(q̂) w,   w = v̂ − αξ
        ∇_w v̂ = T(q→q̂) S(q) − βξ + R(ξ, v̂)v̂ + raise(dissipation(q̂, v̂))

    - `alpha` [1/s], `beta` [1/s²]: gains; the error obeys s² + αs + β whatever the velocity.
    - `budget`: work spent on the geodesic. `Budget()` converges and flags conjugate points; `Budget(newton=1, steps=4)`
      is a fixed amount for real time, and `Budget(newton=1, steps=1, near=True)` a small one for small errors. Metrics
      with closed forms need none.
    - `curvature`: False leaves the curvature term out, to show its effect.
    - `substeps`: Runge–Kutta steps in each sample; None takes as many as dt and the friction need (offline).

    Where no finite geodesic is found, the first-order error of `Intrinsic` replaces it and `result` says
    `NOT_CONVERGED`. Raises `ValueError` for gains that are not positive and finite.
    """

    model: MechanicalSystem
    alpha: Scalar = eqx.field(converter=as_gain)
    beta: Scalar = eqx.field(converter=as_gain)
    budget: Budget = eqx.field(default=Budget(newton=1, steps=4), static=True)
    curvature: bool = eqx.field(default=True, static=True)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("Geodesic", alpha=self.alpha, beta=self.beta)

    def init(self, y: Array, t: Number = 0.0) -> GeodesicState:
        q, v, t, held, age = at_rest(self.model, y, t)
        return GeodesicState(q, v, t, jnp.zeros_like(v), held, age)

    def flow(self, t: Scalar, state: GeodesicState, u: Float[Array, "m"], y: Array) -> GeodesicState:
        # A time derivative has no result to report: conjugate points are not counted.
        found = self._correction(t, state, u, y, self.budget._replace(conjugate=False))
        w = state.v + self.alpha * found.log
        v_dot = found.drive + self.beta * found.log + friction(self.model, t, state.q, state.v, u)
        v_dot = v_dot - self.model.space.connection(state.q, w, state.v)
        # This is only a warm start: it tracks the geodesic found, and the estimate does not depend on how closely.
        log_dot = 10 * self.alpha * (found.back - state.log)
        return GeodesicState(w, v_dot, jnp.ones_like(state.t), log_dot, still(state.held), still(state.age))

    def predict(self, state: GeodesicState, u: Float[Array, "m"], dt: Scalar) -> GeodesicState:
        return predicted(self.model, state, u, dt, self.substeps)

    def correct(self, state: GeodesicState, u: Float[Array, "m"], y: Array) -> tuple[GeodesicState, GeodesicInfo]:
        space, (q, v, t) = self.model.space, state[:3]
        found = self._correction(t, state, u, y, self.budget)
        missing = found.drive - source(self.model, t, q, u)  # acceleration missing in the prediction, which used S(q̂)
        taken = sampled_correction(space, Motion(q, v), self.alpha, self.beta, state.age, -found.log, missing)
        # Move along the geodesic by the given part, and transport the velocity with it.
        corrected, way = v + taken.velocity, taken.part * found.log
        end = space.transport_along(q, way, corrected, self.budget)
        new_q = jnp.where(found.exact, end.q, space.manifold.retract(q, way))
        new_v = jnp.where(found.exact, end.w, corrected - space.connection(q, way, v))
        innovation = self.innovation(state, u, y)
        info = GeodesicInfo(
            innovation, space.norm(q, found.log), found.residual, outcome(new_q, new_v, y, worth(taken, found.result))
        )
        log = (1 - taken.part) * found.back
        return state._replace(q=new_q, v=new_v, log=log, age=aged(self.model, state, y)), info

    def _correction(
        self, t: Scalar, state: GeodesicState, u: Float[Array, "m"], y: Array, budget: Budget
    ) -> _Correction:
        """The geodesic to the measurement, and the acceleration `T S(q) + R(ξ, v̂)v̂` computed from it.

        The search starts at the measurement, so that its geodesic is the one along which S(q) comes to the estimate.
        """
        space, q, v = self.model.space, state.q, state.v
        measured = space.manifold.measured(q, y)
        shot = space.shoot(measured, q, state.log, budget)
        exact = (shot.result != Result.NOT_CONVERGED) & jnp.all(jnp.isfinite(shot.velocity))
        straight = space.manifold.towards(q, y)
        log, back = jnp.where(exact, jnp.stack([-shot.arrival, shot.velocity]), jnp.stack([straight, -straight]))
        s = source(self.model, t, measured, u)
        transported = space.transport_along(measured, shot.velocity, s, budget).w
        drive = jnp.where(exact, transported, s + space.connection(q, straight, s))
        drive = drive - space.curvature(q, log, v, v) if self.curvature else drive
        residual = jnp.where(exact, shot.residual, jnp.inf)
        return _Correction(log, back, drive, residual, jnp.maximum(uniqueness(self.model, q, y), shot.result), exact)
