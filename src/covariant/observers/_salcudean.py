"""Salcudean's observer of the angular velocity of a rigid body: a Lyapunov function, no linearisation, no metric.

Source: Salcudean 1991, A globally convergent angular velocity observer for rigid body motion, IEEE TAC 36. With
`V = ½|h̃|² + k_p(1 − |e₀|)`, h being the momentum in the space frame, `V' = −½ k_p k_v e·I₀⁻¹e`.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry.lie import SO3, quaternion_from_rotation
from covariant.models import MechanicalSystem, Motion, applied_force, body_velocity, resistance, spatial_momentum
from covariant.observers._protocol import (
    AbstractFlowObserver,
    Held,
    Info,
    as_gain,
    at_rest,
    check_positive,
    outcome,
    still,
    uniqueness,
)
from covariant.observers._sampled import predict


class SalcudeanState(NamedTuple):
    """Estimated rotation q (3, 3), momentum in the space frame (3,) [N m s], the time t [s] they belong to, the last
    finite input `held`, and the length `dt` [s] of the last prediction; None in continuous time."""

    q: Float[Array, "3 3"]
    momentum: Vector
    t: Scalar
    held: Held = None
    dt: Scalar | None = None


class Salcudean(AbstractFlowObserver):
    """Observer of a system on SO(3), with e the vector part of the unit quaternion of `R R̂ᵀ` (e₀ ≥ 0):

        R̂' = hat(ω̂) R̂,   ω̂ = I₀⁻¹(ĥ + k_v e),   ĥ' = torque + ½ k_p I₀⁻¹ e,   I₀ = R I Rᵀ, all in the space frame

    For an inertia J that is the same in all directions its error obeys s² + αs + β with α = k_v/2J, β = k_p/4J².

    - `kp` [N m kg m²], `kv` [N m s]: gains.
    - `substeps`: Runge–Kutta steps in each sample; None takes as many as dt and the friction need (offline).

    A step predicts with the model and adds dt times the injected terms, so `kv dt` must stay below the inertia. A
    measurement with any NaN counts as missing as a whole. Raises `ValueError` for a system that is not on SO(3), and
    for gains that are not positive and finite.
    """

    model: MechanicalSystem
    kp: Scalar = eqx.field(converter=as_gain)
    kv: Scalar = eqx.field(converter=as_gain)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("Salcudean", kp=self.kp, kv=self.kv)
        if self.model.manifold != SO3:
            raise ValueError(f"Salcudean: the observer is for SO(3) only; the model is on {self.model.manifold}")

    def init(self, y: Float[Array, "3 3"], t: Number = 0.0) -> SalcudeanState:
        q, rest, t, held, _ = at_rest(self.model, y, t)
        return SalcudeanState(q, rest, t, held, jnp.zeros_like(t))

    def estimate(self, state: SalcudeanState) -> Motion:
        return Motion(state.q, body_velocity(self.model, state.q, state.momentum))

    def flow(self, t: Scalar, state: SalcudeanState, u: Float[Array, "m"], y: Float[Array, "3 3"]) -> SalcudeanState:
        """Time derivative of the state; its field q holds the body velocity of R̂."""
        omega, torque = self._alone(t, state, u, y)
        e = state.q @ quaternion_from_rotation(state.q.T @ y)[1:]
        injected = y @ self.model.space.raise_(y, y.T @ e)
        turning = state.q.T @ (omega + self.kv * injected)
        return SalcudeanState(
            turning, torque + self.kp / 2 * injected, jnp.ones_like(state.t), still(state.held), still(state.dt)
        )

    def predict(self, state: SalcudeanState, u: Float[Array, "m"], dt: Scalar) -> SalcudeanState:
        v = body_velocity(self.model, state.q, state.momentum)
        q, v = predict(self.model, state.t, state.q, v, u, dt, self.substeps)
        return state._replace(q=q, momentum=spatial_momentum(self.model, q, v), t=state.t + dt, dt=dt)

    def correct(
        self, state: SalcudeanState, u: Float[Array, "m"], y: Float[Array, "3 3"]
    ) -> tuple[SalcudeanState, Info]:
        measured = _measured(state.q, y)
        # The feedback: the difference between the flow and the prediction, which used the estimated rotation.
        slope = self.flow(state.t, state, u, measured)
        omega, torque = self._alone(state.t, state, u, state.q)
        q = state.q @ SO3.exp(state.dt * (slope.q - state.q.T @ omega))
        momentum = state.momentum + state.dt * (slope.momentum - torque)
        code = outcome(q, momentum, y, uniqueness(self.model, state.q, measured))
        innovation = self.innovation(state, u, y)
        info = Info(innovation, self.model.space.norm(state.q, innovation), code)
        return state._replace(q=q, momentum=momentum), info

    def innovation(self, state: SalcudeanState, u: Float[Array, "m"], y: Float[Array, "3 3"]) -> Vector:
        return SO3.local(state.q, _measured(state.q, y))

    def _alone(self, t: Scalar, state: SalcudeanState, u: Float[Array, "m"], at: Float[Array, "3 3"]):
        """Angular velocity and torque in the space frame of a body with the estimated momentum at the rotation `at`."""
        v = body_velocity(self.model, at, state.momentum)
        total_torque = applied_force(self.model, t, at, u) + resistance(self.model, t, at, v, u)
        return at @ v, at @ total_torque


def _measured(q: Float[Array, "3 3"], y: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The measured rotation, or the estimate q where it is missing."""
    return jnp.where(jnp.any(jnp.isnan(y)), q, y)


def of_mean_inertia(model: MechanicalSystem, alpha: Number, beta: Number) -> Salcudean:
    """Salcudean's observer with the gains of the error law s² + αs + β for the mean of the principal inertias.

    The law is exact for an inertia that is the same in all directions.
    """
    inertia = float(jnp.trace(model.space(SO3.identity()))) / 3
    return Salcudean(model, 4 * inertia**2 * beta, 2 * inertia * alpha)
