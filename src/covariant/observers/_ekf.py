"""Extended Kalman filter on (q, v): what most people use today.

Source: Gelb 1974, Applied Optimal Estimation, section 6.1; Joseph form of the covariance update.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.geometry import norm
from covariant.models import Lagrangian, position_error
from covariant.observers._protocol import AbstractObserver, Held, check_finite, no_input, outcome
from covariant.observers._sampled import predict


class EKFState(NamedTuple):
    """Estimated configuration and velocity at time t [s], the covariance `cov` (2n, 2n) of their error, and the last
    finite input `held`."""

    q: Vector
    v: Vector
    t: Scalar
    cov: Float[Array, "two_n two_n"]
    held: Held = None


class EKFInfo(NamedTuple):
    """As `Info`, with the predicted covariance of the innovation."""

    innovation: Vector
    distance: Scalar
    innovation_cov: Matrix
    result: Code


class EKF(AbstractObserver):
    """Extended Kalman filter with automatic Jacobians of the integrated model.

    - `process_cov` (n, n): density of the white acceleration noise [(rad/s²)² s, or (m/s²)² s].
    - `measurement_cov` (n, n): covariance of one position sample [rad² or m²].
    - `initial_velocity_std`: standard deviation of the velocity at the start, assumed zero [rad/s or m/s].
    - `substeps`: Runge–Kutta steps a sample; None takes as many as dt and the friction need (offline).

    Raises `ValueError` for covariances that are not finite.
    """

    model: Lagrangian
    process_cov: Matrix
    measurement_cov: Matrix
    initial_velocity_std: Number = 1.0
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_finite("EKF", process_cov=self.process_cov, measurement_cov=self.measurement_cov)
        check_finite("EKF", initial_velocity_std=self.initial_velocity_std)

    def init(self, y: Vector, t: Number = 0.0) -> EKFState:
        velocity_cov = jnp.eye(y.shape[0], dtype=y.dtype) * self.initial_velocity_std**2
        zero = jnp.zeros_like(velocity_cov)
        cov = jnp.block([[self.measurement_cov, zero], [zero, velocity_cov]])
        return EKFState(y, jnp.zeros_like(y), jnp.asarray(t, y.dtype), cov, no_input(self.model, y))

    def estimate(self, state: EKFState) -> Float[Array, "two_n"]:
        return jnp.concatenate([state.q, state.v])

    def predict(self, state: EKFState, u: Float[Array, "m"], dt: Scalar) -> EKFState:
        """Integrate model and covariance over dt [s] with u held."""
        n = state.q.shape[0]

        def motion(x):
            q, v = predict(self.model, state.t, x[:n], x[n:], u, dt, self.substeps)
            moved = jnp.concatenate([q, v])
            return moved, moved

        transition, moved = jax.jacfwd(motion, has_aux=True)(self.estimate(state))
        q_part, cross, v_part = (self.process_cov * dt**k / c for k, c in ((3, 3), (2, 2), (1, 1)))
        noise = jnp.block([[q_part, cross], [cross, v_part]])
        return EKFState(moved[:n], moved[n:], state.t + dt, transition @ state.cov @ transition.T + noise, state.held)

    def correct(self, state: EKFState, y: Vector) -> tuple[EKFState, EKFInfo]:
        """Take the measurement y (n,) in; missing entries (NaN) are left out."""
        n = state.q.shape[0]
        missing = jnp.isnan(y)
        present = jnp.diag(jnp.where(missing, 0.0, 1.0).astype(state.q.dtype))
        # The noise of a missing entry tells nothing of the others', however they are correlated.
        apart = (missing[:, None] | missing[None, :]) & ~jnp.eye(n, dtype=bool)
        measurement_cov = jnp.where(apart, 0.0, self.measurement_cov)
        output = jnp.concatenate([present, jnp.zeros_like(present)], axis=1)
        innovation = -position_error(self.model, state.q, y)
        innovation_cov = output @ state.cov @ output.T + measurement_cov
        gain = solve(innovation_cov, output @ state.cov).T
        x = self.estimate(state) + gain @ innovation
        left = jnp.eye(2 * n, dtype=x.dtype) - gain @ output
        cov = left @ state.cov @ left.T + gain @ measurement_cov @ gain.T
        new = EKFState(x[:n], x[n:], state.t, (cov + cov.T) / 2, state.held)
        distance = norm(self.model.metric, state.q, innovation)
        return new, EKFInfo(innovation, distance, innovation_cov, outcome(new.q, new.v, y))

    def advance(self, state: EKFState, u: Float[Array, "m"], y: Vector, dt: Scalar) -> tuple[EKFState, EKFInfo]:
        return self.correct(self.predict(state, u, dt), y)
