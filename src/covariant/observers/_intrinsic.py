"""The approximate intrinsic observer: explicit, coordinate-bound only beyond first order, locally contracting.

Source: Aghannan & Rouchon 2003, equation (5); friction and second-order error are additions.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry import christoffel, curvature, norm
from covariant.models import Lagrangian, friction, position_error, source
from covariant.observers._protocol import (
    AbstractFlowObserver,
    HeldState,
    Info,
    check_positive,
    no_input,
    outcome,
    still,
)
from covariant.observers._sampled import predict, sampled_gains


class Intrinsic(AbstractFlowObserver):
    """Observer (5) of Aghannan & Rouchon for any `Lagrangian`:

        q̂' = v̂ − αξ
        v̂' = −Γ(q̂)(v̂, q̂') + S(q) − Γ(S, ξ) − βξ + R(ξ, v̂)v̂ + g(q̂)⁻¹ dissipation(q̂, v̂)

    - `alpha` [1/s], `beta` [1/s²]: gains; the error obeys s² + αs + β whatever the velocity.
    - `order`: 1 takes ξ = q̂ − q as published, 2 takes ξ = e − ½Γ(q̂)(e, e), e = q̂ − q.
    - `coefficients`: where Γ and R of the error terms are taken, at the "measured" position as in (5) or at the
      "estimated" one as in (14); the difference is of second order.
    - `curvature`: False leaves the curvature term out, to see what it is for.
    - `substeps`: Runge–Kutta steps a sample; None takes as many as dt and the friction need (offline).

    Raises `ValueError` for gains that are not positive and finite.
    """

    model: Lagrangian
    alpha: Number
    beta: Number
    order: Literal[1, 2] = eqx.field(default=1, static=True)
    coefficients: Literal["measured", "estimated"] = eqx.field(default="measured", static=True)
    curvature: bool = eqx.field(default=True, static=True)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("Intrinsic", alpha=self.alpha, beta=self.beta)
        if self.order not in (1, 2):
            raise ValueError(f"Intrinsic: order must be 1 or 2; got {self.order!r}")
        if self.coefficients not in ("measured", "estimated"):
            raise ValueError(f"Intrinsic: coefficients must be 'measured' or 'estimated'; got {self.coefficients!r}")

    def init(self, y: Vector, t: Number = 0.0) -> HeldState:
        return HeldState(y, jnp.zeros_like(y), jnp.asarray(t, y.dtype), no_input(self.model, y))

    def estimate(self, state: HeldState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    def flow(self, t: Scalar, state: HeldState, u: Float[Array, "m"], y: Vector) -> HeldState:
        q, v, _, held = state
        xi, drive = self._correction(t, q, v, u, y)
        q_dot = v - self.alpha * xi
        v_dot = drive - self.beta * xi + friction(self.model, q, v) - christoffel(self.model.metric, q, v, q_dot)
        return HeldState(q_dot, v_dot, jnp.ones_like(state.t), still(held))

    def advance(self, state: HeldState, u: Float[Array, "m"], y: Vector, dt: Scalar) -> tuple[HeldState, Info]:
        q, v = predict(self.model, state.t, state.q, state.v, u, dt, self.substeps)
        t = state.t + dt
        k1, k2 = sampled_gains(self.alpha, self.beta, dt)
        xi, drive = self._correction(t, q, v, u, y)
        missing = drive - source(self.model, t, q, u)  # what the prediction, made with S(q̂), left out
        new_q = q - k1 * xi
        new_v = v + christoffel(self.model.metric, q, v, k1 * xi) - k2 * xi + dt * missing
        innovation = -position_error(self.model, q, y)
        info = Info(innovation, norm(self.model.metric, q, xi), outcome(new_q, new_v, y))
        return HeldState(new_q, new_v, t), info

    def _correction(self, t: Scalar, q: Vector, v: Vector, u: Float[Array, "m"], y: Vector) -> tuple[Vector, Vector]:
        """Error ξ at q̂ and the acceleration `T S(q) + R(ξ, v̂)v̂` that the measurement calls for."""
        metric = self.model.metric
        e = position_error(self.model, q, y)
        measured = q - e
        at = measured if self.coefficients == "measured" else q
        xi = e if self.order == 1 else e - christoffel(metric, q, e, e) / 2
        s = source(self.model, t, measured, u)
        drive = s - christoffel(metric, at, s, xi)
        return xi, drive + curvature(metric, at, xi, v, v) if self.curvature else drive
