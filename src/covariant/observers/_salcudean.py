"""Salcudean's observer of the angular velocity of a rigid body: a Lyapunov function, no linearisation, no metric.

Source: Salcudean 1991, A globally convergent angular velocity observer for rigid body motion, IEEE TAC 36. With
`V = ½|h̃|² + k_p(1 − |e₀|)`, h the momentum in space, `V' = −½ k_p k_v e·I₀⁻¹e`.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry.lie import SO3, quaternion_from_rotation
from covariant.models import GroupSystem, Motion, body_velocity, friction, source, spatial_momentum
from covariant.observers._group import GroupInfo, check_element, uniqueness
from covariant.observers._protocol import AbstractFlowObserver, outcome
from covariant.observers._sampled import predict


class SalcudeanState(NamedTuple):
    """Estimated rotation g (3, 3), momentum in space (3,) [N m s], and the time t [s] they belong to."""

    g: Float[Array, "3 3"]
    momentum: Vector
    t: Scalar


class Salcudean(AbstractFlowObserver):
    """For a `GroupSystem` on SO(3), with e the vector of the unit quaternion of `R R̂ᵀ` (e₀ ≥ 0):

        R̂' = hat(ω̂) R̂,   ω̂ = I₀⁻¹(ĥ + k_v e),   ĥ' = torque + ½ k_p I₀⁻¹ e,   I₀ = R I Rᵀ, all in space

    For an inertia J the same in all directions its error obeys s² + αs + β with α = k_v/2J, β = k_p/4J².

    - `kp` [N m kg m²], `kv` [N m s]: gains.
    - `substeps`: Runge–Kutta steps a sample; None takes as many as dt and the friction need (offline).

    A step predicts with the model and adds dt times the injected terms, so `kv dt` must stay below the inertia. A
    measurement with any NaN counts as missing as a whole. Raises `ValueError` for another group.
    """

    model: GroupSystem
    kp: Number
    kv: Number
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        if not isinstance(self.model.group, type(SO3)):
            raise ValueError(f"Salcudean: the observer is for SO(3) only; the model is on {self.model.group}")

    def init(self, y: Float[Array, "3 3"], t: Number = 0.0) -> SalcudeanState:
        y = check_element(self.model, y)
        rest = jnp.zeros(3, y.dtype)
        return SalcudeanState(y, rest, jnp.asarray(t, rest.dtype))

    def estimate(self, state: SalcudeanState) -> Motion:
        return Motion(state.g, body_velocity(self.model, state.g, state.momentum))

    def flow(self, t: Scalar, state: SalcudeanState, u: Float[Array, "m"], y: Float[Array, "3 3"]) -> SalcudeanState:
        """Time derivative of the state; in the place of g stands the body velocity of R̂."""
        _, measured, injected = self._error(state, y)
        v = body_velocity(self.model, measured, state.momentum)
        pull = self.model.metric.inertia(source(self.model, t, measured, u) + friction(self.model, measured, v))
        omega = measured @ v + self.kv * injected
        rate = measured @ pull + self.kp / 2 * injected
        return SalcudeanState(state.g.T @ omega, rate, jnp.ones_like(state.t))

    def step(
        self, state: SalcudeanState, u: Float[Array, "m"], y: Float[Array, "3 3"], dt: Scalar
    ) -> tuple[SalcudeanState, GroupInfo]:
        v = body_velocity(self.model, state.g, state.momentum)
        moved = predict(self.model, state.t, state.g, v, u, dt, self.substeps)
        predicted = SalcudeanState(moved.g, spatial_momentum(self.model, *moved), state.t + dt)
        between, _, injected = self._error(predicted, y)
        turn = SO3.exp(moved.g.T @ (dt * self.kv * injected))
        new = SalcudeanState(moved.g @ turn, predicted.momentum + dt * self.kp / 2 * injected, predicted.t)
        innovation = SO3.log(between)
        code = outcome(new.g, new.momentum, y, uniqueness(self.model, between))
        return new, GroupInfo(innovation, self.model.metric.norm(innovation), jnp.zeros_like(dt), code)

    def _error(self, state: SalcudeanState, y: Float[Array, "3 3"]):
        """`R̂ᵀ R`, the rotation R as measured, and `I₀⁻¹e` in space."""
        measured = jnp.where(jnp.any(jnp.isnan(y)), state.g, y)
        between = state.g.T @ measured
        e = state.g @ quaternion_from_rotation(between)[1:]
        return between, measured, measured @ self.model.metric.inertia.solve(measured.T @ e)
