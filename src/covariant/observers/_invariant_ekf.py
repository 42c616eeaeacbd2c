"""Kalman filter with its error on the group: on SO(3) the multiplicative EKF with momentum dynamics, on SE(3) the
left-invariant EKF. What people use today for attitude and pose.

Source: Lefferts, Markley & Shuster 1982 for the multiplicative error; Barrau & Bonnabel 2017, section 3, for the
left-invariant one. Both measure `log(ĝ⁻¹ g)`, in the body.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Code, Element, Matrix, Number, Scalar, Vector
from covariant.models import GroupSystem, Motion
from covariant.observers._group import check_element, uniqueness
from covariant.observers._protocol import AbstractObserver, Held, check_finite, no_input, outcome
from covariant.observers._sampled import predict


class InvariantState(NamedTuple):
    """Estimate (g, v) at time t [s] and the covariance `cov` (2n, 2n) of `(log(ĝ⁻¹ g), v − v̂)`, and the last finite
    input `held`."""

    g: Element
    v: Vector
    t: Scalar
    cov: Float[Array, "two_n two_n"]
    held: Held = None


class InvariantInfo(NamedTuple):
    """`innovation`: `log(ĝ⁻¹ y)`, 0 where missing; `distance`: its length in the metric; `innovation_cov`: its
    predicted covariance; `result`: a `covariant.signals.Result` code."""

    innovation: Vector
    distance: Scalar
    innovation_cov: Matrix
    result: Code


class InvariantEKF(AbstractObserver):
    """Extended Kalman filter on a group and its velocity, with automatic Jacobians of the integrated model.

    - `process_cov` (n, n): density of the white acceleration noise, in the body [(unit of v / s)² s].
    - `measurement_cov` (n, n): covariance of `log(g⁻¹ y)` of one sample.
    - `initial_velocity_std`: standard deviation of the velocity at the start, assumed zero [unit of v].
    - `substeps`: Runge–Kutta steps a sample; None takes as many as dt and the friction need (offline).

    A measurement with any NaN counts as missing as a whole. Raises `ValueError` for covariances that are not finite.
    """

    model: GroupSystem
    process_cov: Matrix
    measurement_cov: Matrix
    initial_velocity_std: Number = 1.0
    substeps: int | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        check_finite("InvariantEKF", process_cov=self.process_cov, measurement_cov=self.measurement_cov)
        check_finite("InvariantEKF", initial_velocity_std=self.initial_velocity_std)

    def init(self, y: Element, t: Number = 0.0) -> InvariantState:
        y = check_element(self.model, y)
        rest = jnp.zeros(self.model.group.dimension, y.real.dtype)
        velocity_cov = jnp.eye(rest.shape[0], dtype=rest.dtype) * self.initial_velocity_std**2
        zero = jnp.zeros_like(velocity_cov)
        cov = jnp.block([[self.measurement_cov, zero], [zero, velocity_cov]])
        return InvariantState(y, rest, jnp.asarray(t, rest.dtype), cov, no_input(self.model, rest))

    def estimate(self, state: InvariantState) -> Motion:
        return Motion(state.g, state.v)

    def predict(self, state: InvariantState, u: Float[Array, "m"], dt: Scalar) -> InvariantState:
        """Integrate model and covariance over dt [s] with u held."""
        group, n = self.model.group, state.v.shape[0]

        def ahead(error):
            start = state.g @ group.exp(error[:n])
            return predict(self.model, state.t, start, state.v + error[n:], u, dt, self.substeps)

        none = jnp.zeros(2 * n, state.v.dtype)
        g, v = ahead(none)

        def error_ahead(error):
            moved, velocity = ahead(error)
            return jnp.concatenate([group.between(g, moved), velocity - v])

        transition = jax.jacfwd(error_ahead)(none)
        q_part, cross, v_part = (self.process_cov * dt**k / c for k, c in ((3, 3), (2, 2), (1, 1)))
        noise = jnp.block([[q_part, cross], [cross, v_part]])
        return InvariantState(g, v, state.t + dt, transition @ state.cov @ transition.T + noise, state.held)

    def correct(self, state: InvariantState, y: Element) -> tuple[InvariantState, InvariantInfo]:
        """Take the measurement y (N, N) in."""
        n = state.v.shape[0]
        missing = jnp.any(jnp.isnan(y))
        between = self.model.group.inverse(state.g) @ jnp.where(missing, state.g, y)
        innovation = self.model.group.log(between)
        innovation_cov = state.cov[:n, :n] + self.measurement_cov
        gain = jnp.where(missing, 0.0, solve(innovation_cov, state.cov[:n]).T)
        error = gain @ innovation
        left = jnp.eye(2 * n, dtype=error.dtype).at[:, :n].add(-gain)
        cov = left @ state.cov @ left.T + gain @ self.measurement_cov @ gain.T
        moved = state.g @ self.model.group.exp(error[:n])
        new = InvariantState(moved, state.v + error[n:], state.t, (cov + cov.T) / 2, state.held)
        distance = self.model.metric.norm(innovation)
        return new, InvariantInfo(
            innovation, distance, innovation_cov, outcome(new.g, new.v, y, uniqueness(self.model, between))
        )

    def advance(
        self, state: InvariantState, u: Float[Array, "m"], y: Element, dt: Scalar
    ) -> tuple[InvariantState, InvariantInfo]:
        return self.correct(self.predict(state, u, dt), y)
