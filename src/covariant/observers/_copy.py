"""The copy observer: the model with output injection, no transport and no curvature.

Source: Aghannan & Rouchon 2003, equation (15), the baseline of their figure 4.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry import christoffel, norm
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


class Copy(AbstractFlowObserver):
    """Observer (15): `q̂' = v̂ − αe`, `v̂' = −Γ(q̂)(v̂, v̂) + S(q) − βe + friction`, e = q̂ − q.

    - `alpha` [1/s], `beta` [1/s²]: gains, which must be high where curvature or velocity is.
    - `substeps`: Runge–Kutta steps a sample; None takes as many as dt and the friction need (offline).

    Raises `ValueError` for gains that are not positive and finite.
    """

    model: Lagrangian
    alpha: Number
    beta: Number
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("Copy", alpha=self.alpha, beta=self.beta)

    def init(self, y: Vector, t: Number = 0.0) -> HeldState:
        return HeldState(y, jnp.zeros_like(y), jnp.asarray(t, y.dtype), no_input(self.model, y))

    def estimate(self, state: HeldState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    def flow(self, t: Scalar, state: HeldState, u: Float[Array, "m"], y: Vector) -> HeldState:
        q, v, _, held = state
        e = position_error(self.model, q, y)
        drive = source(self.model, t, q - e, u) + friction(self.model, q, v)
        v_dot = drive - self.beta * e - christoffel(self.model.metric, q, v, v)
        return HeldState(v - self.alpha * e, v_dot, jnp.ones_like(state.t), still(held))

    def advance(self, state: HeldState, u: Float[Array, "m"], y: Vector, dt: Scalar) -> tuple[HeldState, Info]:
        q, v = predict(self.model, state.t, state.q, state.v, u, dt, self.substeps)
        t = state.t + dt
        k1, k2 = sampled_gains(self.alpha, self.beta, dt)
        e = position_error(self.model, q, y)
        missing = source(self.model, t, q - e, u) - source(self.model, t, q, u)
        new_q, new_v = q - k1 * e, v - k2 * e + dt * missing
        return HeldState(new_q, new_v, t), Info(-e, norm(self.model.metric, q, e), outcome(new_q, new_v, y))
