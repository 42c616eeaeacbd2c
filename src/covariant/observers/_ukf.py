"""Unscented Kalman filter: what is uncertain is sent through the model as a few points, and nothing is differentiated.

The error is that of the EKF, `(local(q̂, q), v − v̂)` in the frame of the space, so that on a group the points are drawn
around the estimate by its retraction. The mean on a group is taken to first order: in the frame at the propagated
centre, and the deviations are read from it. Its square root is carried, and all weights of the covariance are positive,
so that it never becomes indefinite.

A measured configuration is linear in that error, `local(q̂, y)`, and what the unscented transform makes of a linear map
is exact: the correction is the Kalman filter's own, and takes no points.

Source: Julier & Uhlmann 2004, Unscented filtering and nonlinear estimation, Proc. IEEE 92(3), for the scaled set;
Brossard, Barrau & Bonnabel 2020, A code for unscented Kalman filtering on manifolds, ICRA; van der Merwe & Wan 2001,
The square-root unscented Kalman filter, ICASSP; Bar-Shalom, Li & Kirubarajan 2001, section 5.4, for the gate.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Inexact, Int

from covariant._linalg import semidefinite_root, triangular
from covariant._typing import Code, Number, Scalar, Vector
from covariant.models import MechanicalSystem, Motion
from covariant.observers._covariance import Covariance, check_covariance, covariance_at
from covariant.observers._ekf import EKFInfo, ekf_info
from covariant.observers._gate import Gate, open_gate
from covariant.observers._gated_filter import AbstractMechanicalFilter, Expectation
from covariant.observers._protocol import Held, as_gain, at_rest, check_finite
from covariant.observers._sampled import predict
from covariant.observers._square_root import diagonal, updated, white_acceleration


class UKFState(NamedTuple):
    """Estimated configuration and velocity at time t [s], and a square root `root` (2n, 2n) of the covariance of
    `(local(q̂, q), v − v̂)`.

    - `refused` (n,), `scale` (n,): what the gate remembers; see `Gate.judge`.
    - `held`: the last finite input.
    """

    q: Inexact[Array, "..."]
    v: Vector
    t: Scalar
    root: Float[Array, "two_n two_n"]
    refused: Int[Array, "n"]
    scale: Vector
    held: Held = None


class UKF(AbstractMechanicalFilter):
    """Unscented Kalman filter with 4n + 1 points, in square-root form.

    - `process_cov`: density of the white acceleration noise [(rad/s²)² s, or (m/s²)² s].
    - `measurement_cov`: covariance of `local(q, y)` of one sample [rad² or m²].
      Each is a matrix (n, n) in the frame, the same everywhere; a function of the configuration; or a number, a
      variance in metric units, the same in every direction.
    - `initial_velocity_std`: standard deviation of the velocity at the start, assumed zero [rad/s or m/s].
    - `substeps`: Runge–Kutta steps a sample; None takes as many as dt and the friction need (offline).
    - `spread`: how far out the points are, in units of √(2n) standard deviations: α of the scaled set, whose other
      numbers are κ = 0 and β = 2. Nearer points take less of what is far from quadratic for the spread of the whole;
      between .52 and 1.93 no weight of the covariance is negative.
    - `gate`: which measurements are refused as outliers; None refuses none. See `Gate`.

    Raises `ValueError` for numbers and matrices that are no covariances, for a measurement without noise, and for a
    spread outside of these bounds.
    """

    model: MechanicalSystem
    process_cov: Covariance = eqx.field(converter=as_gain)
    measurement_cov: Covariance = eqx.field(converter=as_gain)
    initial_velocity_std: Scalar = eqx.field(default=1.0, converter=as_gain)
    substeps: int | None = eqx.field(default=None, static=True)
    spread: float = eqx.field(default=0.6, static=True)
    gate: Gate | None = Gate()

    def __check_init__(self):
        check_covariance("UKF", "process_cov", self.process_cov)
        check_covariance("UKF", "measurement_cov", self.measurement_cov, positive=True)
        check_finite("UKF", initial_velocity_std=self.initial_velocity_std)
        if not 0.52 <= self.spread <= 1.93:
            raise ValueError(f"UKF: spread must be between .52 and 1.93; got {self.spread}")

    def init(self, y: Array, t: Number = 0.0) -> UKFState:
        q, v, t, held, _ = at_rest(self.model, y, t)
        return UKFState(q, v, t, self._first_root(q, v), *open_gate(v), held)

    def cov(self, state: UKFState) -> Float[Array, "two_n two_n"]:
        """The covariance of `(local(q̂, q), v − v̂)`."""
        return state.root @ state.root.T

    def predict(self, state: UKFState, u: Float[Array, "m"], dt: Scalar) -> UKFState:
        """Integrate every point over dt [s] with u held; their mean and covariance, and the noise added."""
        manifold, n = self.model.manifold, state.v.shape[0]
        squared = 2 * n * self.spread**2  # L + λ = α²(L + κ) of the scaled set, L = 2n

        def ahead(error):
            start = manifold.retract(state.q, error[:n])
            return predict(self.model, state.t, start, state.v + error[n:], u, dt, self.substeps)

        points = squared**0.5 * state.root.T
        moved = jax.vmap(ahead)(jnp.concatenate([jnp.zeros_like(points[:1]), points, -points]))

        def seen_from(q, v):
            return jax.vmap(lambda p, w: jnp.concatenate([manifold.local(q, p), w - v]))(*moved)

        first = Motion(moved.q[0], moved.v[0])
        mean = jnp.sum(seen_from(*first), axis=0) / (2 * squared)
        q, v = manifold.retract(first.q, mean[:n]), first.v + mean[n:]
        deviations = seen_from(q, v)
        centre = 4 - self.spread**-2 - self.spread**2  # λ/(L + λ) + 1 − α² + β
        columns = jnp.concatenate([centre**0.5 * deviations[:1], deviations[1:] / (2 * squared) ** 0.5]).T
        noise = white_acceleration(covariance_at(self.process_cov, self.model.space, q), dt)
        root = triangular(jnp.concatenate([columns, noise.astype(columns.dtype)], axis=1))
        return state._replace(q=q, v=v, t=state.t + dt, root=root)

    def _expected(self, state: UKFState, u: Float[Array, "m"], y: Array) -> Expectation:
        manifold, n = self.model.manifold, state.v.shape[0]
        noise = covariance_at(self.measurement_cov, self.model.space, state.q)
        cov = state.root[:n] @ state.root[:n].T + noise
        return Expectation(y, manifold.towards(state.q, y), cov, ~manifold.missing(y), details=noise)

    def _used(self, state: UKFState, y: Array, expected: Expectation, used: Bool[Array, "n"]) -> UKFState:
        n = state.v.shape[0]
        gain, root = updated(state.root, state.root[:n], expected.details, used)
        error = gain @ expected.innovation
        return state._replace(q=self.model.manifold.retract(state.q, error[:n]), v=state.v + error[n:], root=root)

    def _started_anew(self, state: UKFState, corrected: UKFState, y: Array, expected: Expectation) -> UKFState:
        measured = self.model.manifold.measured(state.q, y)
        return corrected._replace(q=measured, v=state.v, root=self._first_root(measured, state.v))

    def _info(self, state: UKFState, new: UKFState, expected: Expectation, result: Code) -> EKFInfo:
        std = jnp.sqrt(jnp.sum(new.root[state.v.shape[0] :] ** 2, axis=1))
        return ekf_info(self.model, state.q, expected, std, result)

    def _first_root(self, q: Array, v: Vector) -> Float[Array, "two_n two_n"]:
        position = semidefinite_root(covariance_at(self.measurement_cov, self.model.space, q)).astype(v.dtype)
        return diagonal(position, jnp.eye(v.shape[0], dtype=v.dtype) * self.initial_velocity_std)
