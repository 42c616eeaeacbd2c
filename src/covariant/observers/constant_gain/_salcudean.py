"""Defines Salcudean's observer of a body's angular velocity, by a Lyapunov function, without linearisation or a metric.

Source: Salcudean 1991, A globally convergent angular velocity observer for rigid body motion, IEEE TAC 36. With
`V = ½|h̃|² + k_p(1 − |e₀|)`, where h is the momentum in the space frame, `V' = −½ k_p k_v e·I₀⁻¹e`.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Number, Scalar, Vector
from covariant.geometry.lie import SO3, quaternion_from_rotation
from covariant.models import MechanicalSystem, Motion, applied_force, resistance
from covariant.observers.base import (
    AbstractFlowObserver,
    Info,
    LastInput,
    as_gain,
    at_rest,
    check_positive,
    outcome,
    predict,
    step_length,
    still,
    uniqueness,
)
from scalargraph.errors import InputError


class SalcudeanState(NamedTuple):
    """State of a `Salcudean` observer.

    Attributes:
        q: Estimated rotation (3, 3).
        momentum: Estimated momentum (3,) [N m s], in the space frame.
        t: Time [s] of the estimate.
        last_input: The last finite input (m,); None in continuous time.
        dt: Length [s] of the last prediction; None in continuous time.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> state = observers.Salcudean(models.free_body((1.0, 2.0, 3.0)), kp=4.0, kv=2.0).init(jnp.eye(3))
        >>> state.momentum.tolist()
        [0.0, 0.0, 0.0]
    """

    q: Float[Array, "3 3"]
    momentum: Vector
    t: Scalar
    last_input: LastInput = None
    dt: Scalar | None = None


class Salcudean(AbstractFlowObserver):
    """Observer of the angular velocity of a system on SO(3).

    With e the vector part of the unit quaternion of `R R̂ᵀ` (e₀ ≥ 0) it is

        R̂' = hat(ω̂) R̂,   ω̂ = I₀⁻¹(ĥ + k_v e),   ĥ' = torque + ½ k_p I₀⁻¹ e,   I₀ = R I Rᵀ, all in the space frame

    For an inertia J that is equal in all directions its error obeys s² + αs + β with α = k_v/2J, β = k_p/4J². A step
    predicts with the model and adds dt times the injected terms, so `kv dt` must stay below the inertia. A measurement
    that contains NaN counts as missing as a whole.

    Attributes:
        model: Mechanical system on SO(3).
        kp: Gain k_p [N m kg m²].
        kv: Gain k_v [N m s].
        substeps: Number of Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need
            (offline).

    Raises:
        ValueError: The system is not on SO(3), or a gain is not positive and finite.

    Example:
        A body that rotates by 0.2 rad about its third axis from an estimate at rest; e = sin 0.1:

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> observer = observers.Salcudean(models.free_body((1.0, 2.0, 3.0)), kp=9.0, kv=6.0)
        >>> state = observers.continuous(observer.init(jnp.eye(3)))
        >>> y = models.marine.euler_rotation(jnp.array([0.0, 0.0, 0.2]))
        >>> body_velocity = observer.flow(state.t, state, jnp.zeros(3), y).q
        >>> bool(np.isclose(body_velocity[2], 6.0 / 3.0 * np.sin(0.1)))
        True
    """

    model: MechanicalSystem
    kp: Scalar = eqx.field(converter=as_gain)
    kv: Scalar = eqx.field(converter=as_gain)
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_positive("Salcudean", kp=self.kp, kv=self.kv)
        if self.model.manifold != SO3:
            raise InputError(f"Salcudean: the observer is for SO(3) only; the model is on {self.model.manifold}")

    def init(self, y: Float[Array, "3 3"], t: Number = 0.0) -> SalcudeanState:
        q, rest, t, last_input, _ = at_rest(self.model, y, t)
        return SalcudeanState(q, rest, t, last_input, jnp.zeros_like(t))

    def estimate(self, state: SalcudeanState) -> Motion:
        return Motion(state.q, self._velocity(state.q, state.momentum))

    def flow(self, t: Scalar, state: SalcudeanState, u: Float[Array, "m"], y: Float[Array, "3 3"]) -> SalcudeanState:
        """Time derivative of the state, for measurements in continuous time.

        Args:
            t: Time [s].
            state: State of this observer.
            u: Input (m,) at the time t.
            y: Measured rotation (3, 3), complete.

        Returns:
            The derivative in the form of the state; its field q holds the body velocity (3,) of R̂.
        """
        omega, torque = self._free_motion(t, state, u, y)
        # R R̂ᵀ = R̂ (R̂ᵀR) R̂ᵀ, so R̂ rotates the vector part of R̂ᵀR into that of R R̂ᵀ.
        e = state.q @ quaternion_from_rotation(state.q.T @ y)[1:]
        # I₀⁻¹ = R I⁻¹ Rᵀ at the measured rotation, since the momentum is in the space frame.
        injected = y @ self.model.space.raise_(y, y.T @ e)
        turning = state.q.T @ (omega + self.kv * injected)
        return SalcudeanState(
            turning, torque + self.kp / 2 * injected, jnp.ones_like(state.t), still(state.last_input), still(state.dt)
        )

    def predict(self, state: SalcudeanState, u: Float[Array, "m"], dt: Scalar) -> SalcudeanState:
        v = self._velocity(state.q, state.momentum)
        q, v = predict(self.model, state.t, state.q, v, u, dt, self.substeps)
        return state._replace(q=q, momentum=q @ self.model.space.lower(q, v), t=state.t + dt, dt=dt)

    def correct(
        self, state: SalcudeanState, u: Float[Array, "m"], y: Float[Array, "3 3"]
    ) -> tuple[SalcudeanState, Info]:
        measured = _measured_rotation(state.q, y)
        # The feedback is the difference between the flow and the prediction, which used the estimated rotation.
        slope = self.flow(state.t, state, u, measured)
        omega, torque = self._free_motion(state.t, state, u, state.q)
        dt = step_length(state)
        q = state.q @ SO3.exp(dt * (slope.q - state.q.T @ omega))
        momentum = state.momentum + dt * (slope.momentum - torque)
        code = outcome(q, momentum, y, uniqueness(self.model, state.q, measured))
        innovation = self.innovation(state, u, y)
        info = Info(innovation, self.model.space.norm(state.q, innovation), code)
        return state._replace(q=q, momentum=momentum), info

    def innovation(self, state: SalcudeanState, u: Float[Array, "m"], y: Float[Array, "3 3"]) -> Vector:
        return SO3.local(state.q, _measured_rotation(state.q, y))

    def _velocity(self, rotation: Float[Array, "3 3"], momentum: Vector) -> Vector:
        """Body velocity with a momentum in the space frame."""
        return self.model.space.raise_(rotation, rotation.T @ momentum)

    def _free_motion(self, t: Scalar, state: SalcudeanState, u: Float[Array, "m"], rotation: Float[Array, "3 3"]):
        """Angular velocity and torque in the space frame of a body with the estimated momentum at a rotation."""
        v = self._velocity(rotation, state.momentum)
        total_torque = applied_force(self.model, t, rotation, u) + resistance(self.model, t, rotation, v, u)
        return rotation @ v, rotation @ total_torque


def _measured_rotation(q: Float[Array, "3 3"], y: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The measured rotation, or the estimate q where it is missing."""
    return jnp.where(jnp.any(jnp.isnan(y)), q, y)


def of_mean_inertia(model: MechanicalSystem, alpha: Number, beta: Number) -> Salcudean:
    """Salcudean's observer, with gains that give the error law s² + αs + β for the mean of the principal inertias.

    The law is exact for an inertia that is equal in all directions.
    """
    inertia = float(jnp.trace(model.space(SO3.identity()))) / 3
    return Salcudean(model, 4 * inertia**2 * beta, 2 * inertia * alpha)
