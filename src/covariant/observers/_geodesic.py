"""The exact intrinsic observer: geodesic error, parallel transport, curvature. The same in all coordinates.

Source: Aghannan & Rouchon 2003, equation (2), with the curvature sign of `covariant.geometry`.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Code, Number, Scalar, Vector
from covariant.geometry import Budget, Shot, christoffel, curvature, norm, shoot, transport_along
from covariant.models import Lagrangian, friction, position_error, source
from covariant.observers._protocol import AbstractFlowObserver, Held, check_positive, no_input, outcome, still
from covariant.observers._sampled import predict, sampled_gains


class GeodesicState(NamedTuple):
    """Estimate (q, v) at time t [s], and `log` = log_q̂(q) as last found, to start the next search;
    `held` is the last finite input."""

    q: Vector
    v: Vector
    t: Scalar
    log: Vector
    held: Held = None


class GeodesicInfo(NamedTuple):
    """As `Info`, with the metric length `residual` by which the geodesic missed the measurement."""

    innovation: Vector
    distance: Scalar
    residual: Scalar
    result: Code


class Geodesic(AbstractFlowObserver):
    """Observer (2) of Aghannan & Rouchon for any `Lagrangian`, with ξ = −log_q̂(q):

        q̂' = v̂ − αξ
        ∇_q̂' v̂ = T(q→q̂) S(q) − βξ + R(ξ, v̂)v̂ + g(q̂)⁻¹ dissipation(q̂, v̂)

    - `alpha` [1/s], `beta` [1/s²]: gains; the error obeys s² + αs + β whatever the velocity.
    - `budget`: work spent on the geodesic. `Budget()` converges and flags conjugate points; `Budget(newton=1, steps=4)`
      is a fixed amount for real time. Metrics with closed forms need neither.
    - `curvature`: False leaves the curvature term out, to see what it is for.
    - `substeps`: Runge–Kutta steps a sample; None takes as many as dt and the friction need (offline).

    Raises `ValueError` for gains that are not positive and finite.
    """

    model: Lagrangian
    alpha: Number
    beta: Number
    budget: Budget = eqx.field(default=Budget(newton=1, steps=4), static=True)
    curvature: bool = eqx.field(default=True, static=True)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("Geodesic", alpha=self.alpha, beta=self.beta)

    def init(self, y: Vector, t: Number = 0.0) -> GeodesicState:
        none = jnp.zeros_like(y)
        return GeodesicState(y, none, jnp.asarray(t, y.dtype), none, no_input(self.model, y))

    def estimate(self, state: GeodesicState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    def flow(self, t: Scalar, state: GeodesicState, u: Float[Array, "m"], y: Vector) -> GeodesicState:
        q, v, *_ = state
        shot, drive = self._correction(t, state, u, y)
        q_dot = v + self.alpha * shot.velocity
        v_dot = drive + self.beta * shot.velocity + friction(self.model, q, v)
        v_dot = v_dot - christoffel(self.model.metric, q, v, q_dot)
        # Only a warm start: it follows the geodesic found, and no estimate depends on how closely.
        log_dot = 10 * self.alpha * (shot.velocity - state.log)
        return GeodesicState(q_dot, v_dot, jnp.ones_like(state.t), log_dot, still(state.held))

    def advance(
        self, state: GeodesicState, u: Float[Array, "m"], y: Vector, dt: Scalar
    ) -> tuple[GeodesicState, GeodesicInfo]:
        q, v = predict(self.model, state.t, state.q, state.v, u, dt, self.substeps)
        t = state.t + dt
        k1, k2 = sampled_gains(self.alpha, self.beta, dt)
        shot, drive = self._correction(t, GeodesicState(q, v, t, state.log), u, y)
        missing = drive - source(self.model, t, q, u)  # what the prediction, made with S(q̂), left out
        # Go the fraction k1 along the geodesic to the measurement; velocity and the rest of the geodesic come along.
        carried = jnp.stack([v + k2 * shot.velocity + dt * missing, (1 - k1) * shot.velocity])
        end = transport_along(self.model.metric, q, k1 * shot.velocity, carried, self.budget)
        new = GeodesicState(end.q, end.w[0], t, end.w[1])
        innovation = -position_error(self.model, q, y)
        distance = norm(self.model.metric, q, shot.velocity)
        return new, GeodesicInfo(innovation, distance, shot.residual, outcome(new.q, new.v, y, shot.result))

    def _correction(self, t: Scalar, state: GeodesicState, u: Float[Array, "m"], y: Vector) -> tuple[Shot, Vector]:
        """Geodesic to the measurement and the acceleration `T S(q) + R(ξ, v̂)v̂` that the measurement calls for."""
        metric, q, v = self.model.metric, state.q, state.v
        measured = q - position_error(self.model, q, y)
        shot = shoot(metric, q, measured, state.log, self.budget)
        s = source(self.model, t, measured, u)
        drive = transport_along(metric, measured, -shot.arrival, s, self.budget).w
        return shot, drive + curvature(metric, q, -shot.velocity, v, v) if self.curvature else drive
