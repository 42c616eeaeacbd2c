"""Extended Kalman filter, the standard choice in practice, with its error in the frame of the space.

In coordinates it is the usual filter on (q, v); on SO(3) the multiplicative one with momentum dynamics; on SE(3) the
left-invariant one.

Source: Gelb 1974, Applied Optimal Estimation, section 6.1; Joseph form of the covariance update. Lefferts, Markley &
Shuster 1982 for the multiplicative error; Barrau & Bonnabel 2017, section 3, for the left-invariant one; Bar-Shalom,
Li & Kirubarajan 2001, section 5.4, for the gate.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Inexact, Int

from covariant._linalg import solve
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.models import MechanicalSystem
from covariant.observers._gate import Gate, open_gate
from covariant.observers._gated_filter import AbstractMechanicalFilter, Expectation
from covariant.observers._protocol import Held, as_gain, at_rest, check_finite
from covariant.observers._sampled import predict
from covariant.observers._square_root import normalised_square


class EKFState(NamedTuple):
    """Estimated configuration and velocity at time t [s], and the covariance `cov` (2n, 2n) of `(local(q̂, q), v − v̂)`.

    - `refused` (n,), `scale` (n,): what the gate remembers; see `Gate.judge`.
    - `held`: the last finite input.
    """

    q: Inexact[Array, "..."]
    v: Vector
    t: Scalar
    cov: Float[Array, "two_n two_n"]
    refused: Int[Array, "n"]
    scale: Vector
    held: Held = None


class EKFInfo(NamedTuple):
    """As `Info`, with the predicted covariance of the innovation and its normalised square `nis`, and the standard
    deviations `velocity_std` (n,) of the velocity after the correction. Where the model is right, `nis` is
    χ²-distributed with as many degrees of freedom as there are measured components."""

    innovation: Vector
    distance: Scalar
    innovation_cov: Matrix
    nis: Scalar
    velocity_std: Vector
    result: Code


class EKF(AbstractMechanicalFilter):
    """Extended Kalman filter whose Jacobians are those of the integrated model, by automatic differentiation.

    - `process_cov` (n, n): spectral density of the white acceleration noise, in the frame [(rad/s²)² s, or (m/s²)² s].
    - `measurement_cov` (n, n): covariance of `local(q, y)` of one sample [rad² or m²].
    - `initial_velocity_std`: standard deviation of the initial velocity, which is assumed zero [rad/s or m/s].
    - `substeps`: Runge–Kutta steps in each sample; None takes as many as dt and the friction need (offline).
    - `gate`: which measurements are refused as outliers; None refuses none. See `Gate`.

    Raises `ValueError` for covariances that are not finite.
    """

    model: MechanicalSystem
    process_cov: Matrix
    measurement_cov: Matrix
    initial_velocity_std: Scalar = eqx.field(default=1.0, converter=as_gain)
    substeps: int | None = eqx.field(default=None, static=True)
    gate: Gate | None = Gate()

    def __check_init__(self):
        check_finite("EKF", process_cov=self.process_cov, measurement_cov=self.measurement_cov)
        check_finite("EKF", initial_velocity_std=self.initial_velocity_std)

    def init(self, y: Array, t: Number = 0.0) -> EKFState:
        q, v, t, held, _ = at_rest(self.model, y, t)
        return EKFState(q, v, t, self._first_cov(v), *open_gate(v), held)

    def predict(self, state: EKFState, u: Float[Array, "m"], dt: Scalar) -> EKFState:
        """Integrate model and covariance over dt [s] with u held constant."""
        n = state.v.shape[0]

        def error_ahead(error):
            start = self.model.manifold.retract(state.q, error[:n])
            moved = predict(self.model, state.t, start, state.v + error[n:], u, dt, self.substeps)
            apart = self.model.manifold.local(jax.lax.stop_gradient(moved.q), moved.q)
            return jnp.concatenate([apart, moved.v]), moved

        transition, (q, v) = jax.jacfwd(error_ahead, has_aux=True)(jnp.zeros(2 * n, state.v.dtype))
        q_part, cross, v_part = (self.process_cov * dt**k / c for k, c in ((3, 3), (2, 2), (1, 1)))
        noise = jnp.block([[q_part, cross], [cross, v_part]])
        return state._replace(q=q, v=v, t=state.t + dt, cov=transition @ state.cov @ transition.T + noise)

    def _expected(self, state: EKFState, u: Float[Array, "m"], y: Array) -> Expectation:
        n, manifold = state.v.shape[0], self.model.manifold
        cov = state.cov[:n, :n] + self.measurement_cov
        return Expectation(y, manifold.towards(state.q, y), cov, ~manifold.missing(y))

    def _used(self, state: EKFState, y: Array, expected: Expectation, used: Bool[Array, "n"]) -> EKFState:
        n = state.v.shape[0]
        present = jnp.diag(used.astype(state.v.dtype))
        # The noise of an entry that is not used must not affect the others, even where the two are correlated.
        apart = ~(used[:, None] & used[None, :]) & ~jnp.eye(n, dtype=bool)
        measurement_cov = jnp.where(apart, 0.0, self.measurement_cov)
        output = jnp.concatenate([present, jnp.zeros_like(present)], axis=1)
        gain = solve(output @ state.cov @ output.T + measurement_cov, output @ state.cov).T
        error = gain @ expected.innovation
        left = jnp.eye(2 * n, dtype=error.dtype) - gain @ output
        cov = left @ state.cov @ left.T + gain @ measurement_cov @ gain.T
        q, v = self.model.manifold.retract(state.q, error[:n]), state.v + error[n:]
        return state._replace(q=q, v=v, cov=(cov + cov.T) / 2)

    def _started_anew(self, state: EKFState, corrected: EKFState, y: Array, expected: Expectation) -> EKFState:
        q = self.model.manifold.measured(state.q, y)
        return corrected._replace(q=q, v=state.v, cov=self._first_cov(state.v))

    def _info(self, state: EKFState, new: EKFState, expected: Expectation, result: Code) -> EKFInfo:
        std = jnp.sqrt(jnp.diag(new.cov)[state.v.shape[0] :])
        return ekf_info(self.model, state.q, expected, std, result)

    def _first_cov(self, v: Vector) -> Float[Array, "two_n two_n"]:
        velocity_cov = jnp.eye(v.shape[0], dtype=v.dtype) * self.initial_velocity_std**2
        zero = jnp.zeros_like(velocity_cov)
        return jnp.block([[self.measurement_cov, zero], [zero, velocity_cov]])


def ekf_info(model: MechanicalSystem, q: Array, expected: Expectation, std: Vector, result: Code) -> EKFInfo:
    """The info of a correction at the predicted configuration q, with the standard deviations of the velocity."""
    _, innovation, cov, present, *_ = expected
    nis = normalised_square(cov, innovation, present)
    return EKFInfo(innovation, model.space.norm(q, innovation), cov, nis, std, result)
