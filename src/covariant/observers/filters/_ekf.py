"""Defines the extended Kalman filter, the standard choice, with the error expressed in the frame of the space.

In coordinates it is the usual filter on (q, v); on SO(3) it is the multiplicative filter with momentum dynamics; on
SE(3) it is the left-invariant filter.

Source: Gelb 1974, Applied Optimal Estimation, section 6.1; Joseph form of the covariance update. Lefferts, Markley &
Shuster 1982 for the multiplicative error; Barrau & Bonnabel 2017, section 3, for the left-invariant one; Bar-Shalom,
Li & Kirubarajan 2001, section 5.4, for the gate.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Inexact

from covariant._linalg import semidefinite_root, solve
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.models import MechanicalSystem
from covariant.observers.base import (
    Gate,
    GateMemory,
    LastInput,
    Velocity,
    as_gain,
    at_rest,
    check_finite,
    check_free,
    isotropic,
    normalised_square,
    predict,
    with_block,
)
from covariant.observers.filters._gated_filter import AbstractMechanicalFilter, Expectation, Moved, Used
from covariant.observers.filters._noise_scale import NoiseScale, factor_of


class EKFState(NamedTuple):
    """State of an `EKF`: the estimate, its covariance, and the memory of the gate.

    Attributes:
        q: Estimated configuration q̂: coordinates (n,), or a group element (N, N).
        v: Estimated velocity v̂ (n,) in the frame of the space.
        t: Time [s] of the estimate.
        cov: Covariance (2n, 2n) of the error `(local(q̂, q), v − v̂)`.
        gate: Memory of the gate.
        last_input: Last finite input (m,), which replaces an input that is not finite; None if none is stored.
        noise_scale: Learnt size of the unknown noise, and its sensitivities; None if the filter is not adaptive.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1.0]]), np.array([[1e-4]]), initial_velocity_std=2.0)
        >>> ekf.init(np.array([0.1])).cov.tolist()
        [[0.0001, 0.0], [0.0, 4.0]]
    """

    q: Inexact[Array, "..."]
    v: Vector
    t: Scalar
    cov: Float[Array, "two_n two_n"]
    gate: GateMemory
    last_input: LastInput = None
    noise_scale: NoiseScale | None = None


class EKFInfo(NamedTuple):
    """Diagnostics of a step of an `EKF` or a `UKF`.

    Attributes:
        innovation: Difference (n,) from the predicted configuration to the measurement, 0 where it is missing.
        distance: Length of the innovation in the metric.
        innovation_cov: Predicted covariance (n, n) of the innovation.
        nis: Normalised innovation squared, `rᵀS⁻¹r` of the measured components. If the model is right, it is
            χ²-distributed with as many degrees of freedom as there are measured components.
        velocity_std: Standard deviations (n,) of the velocity after the correction.
        result: A `covariant.signals.StepCode` code.
        noise_scale: Learnt variance of the unknown noise, relative to the initial setting; 1 if the filter is not
            adaptive.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1.0]]), np.array([[1e-4]]), substeps=1)
        >>> record = Record(np.array([0.0, 0.01]), np.zeros((2, 1)), np.array([[0.1], [0.11]]))
        >>> run = observers.run(ekf, record)
        >>> run.info.innovation[1].round(3).tolist(), round(run.info.nis[1].item(), 1), run.info.result[1].item()
        ([0.01], 0.3, 0)
    """

    innovation: Vector
    distance: Scalar
    innovation_cov: Matrix
    nis: Scalar
    velocity_std: Vector
    result: Code
    noise_scale: Scalar | float = 1.0


class EKF(AbstractMechanicalFilter):
    """Extended Kalman filter whose Jacobians are those of the integrated model, by automatic differentiation.

    It is the standard choice if the noise is known and the initial velocity is not. Its gain follows from the
    covariances, so it adapts to gaps and to the sampling rate. It is cheaper than `UKF`; in coordinates its result
    depends on the chart. `IntrinsicKalman` does not depend on the chart, and also estimates forces, biases and
    parameters. `StateEKF` is the filter for a model in state-space form.

    Attributes:
        model: Mechanical system, in coordinates or on a Lie group.
        process_cov: Spectral density (n, n) of the white acceleration noise, in the frame
            [(rad/s²)² s, or (m/s²)² s].
        measurement_cov: Covariance (n, n) of `local(q, y)` of one sample [rad² or m²].
        initial_velocity_std: Standard deviation of the initial velocity, whose mean is zero [rad/s or m/s], one for all
            components or one for each (n,); 1 by default. The gate uses it as the usual speed.
        substeps: Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need (offline).
        gate: Gate that refuses outliers; None refuses nothing. See `Gate`.
        adaptive: Whether the filter learns the size of the unknown noise from its innovations: `process_cov` is then a
            lower bound, and the covariance grows if the log shows more. False by default.

    Raises:
        ValueError: A covariance or the standard deviation is not finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 5.0, 501)
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1e-3]]), np.array([[1e-4]]), substeps=1)
        >>> run = observers.run(ekf, Record(t, np.zeros((501, 1)), np.cos(t)[:, None]))
        >>> bool(np.allclose(run.estimate[-1], [np.cos(5.0), -np.sin(5.0)], atol=1e-2))
        True
    """

    model: MechanicalSystem
    process_cov: Matrix
    measurement_cov: Matrix
    initial_velocity_std: Scalar | Vector = eqx.field(default=1.0, converter=as_gain)
    substeps: int | None = eqx.field(default=None, static=True)
    gate: Gate | None = Gate()
    adaptive: bool = eqx.field(default=False, static=True)

    def __check_init__(self):
        check_finite("EKF", process_cov=self.process_cov, measurement_cov=self.measurement_cov)
        check_finite("EKF", initial_velocity_std=self.initial_velocity_std)
        check_free("EKF", self.model)

    def init(self, y: Array, t: Number = 0.0) -> EKFState:
        q, v, t, last_input, _ = at_rest(self.model, y, t)
        cov = self._first_cov(isotropic(self.initial_velocity_std, v))
        scale = NoiseScale.at_start(cov) if self.adaptive else None
        return EKFState(q, v, t, cov, GateMemory.at_start(v), last_input, scale)

    def _predicted(
        self, state: EKFState, u: Float[Array, "m"], dt: Scalar, carry: bool
    ) -> tuple[EKFState, Matrix | None]:
        n = state.v.shape[0]

        def propagated_error(error):
            start = self.model.manifold.retract(state.q, error[:n])
            end = predict(self.model, state.t, start, state.v + error[n:], u, dt, self.substeps)
            # Its value is zero, since the end is compared with itself; its derivative is the displacement in the frame.
            apart = self.model.manifold.local(jax.lax.stop_gradient(end.q), end.q)
            return jnp.concatenate([apart, end.v]), end

        transition, (q, v) = jax.jacfwd(propagated_error, has_aux=True)(jnp.zeros(2 * n, state.v.dtype))
        # Covariance of the double and the single integral of white noise over dt: dt³/3, dt²/2, dt.
        q_part, cross, v_part = (self.process_cov * dt**k / c for k, c in ((3, 3), (2, 2), (1, 1)))
        noise, scale = jnp.block([[q_part, cross], [cross, v_part]]), state.noise_scale
        if scale is not None:
            noise = scale.factor * noise
            scale = scale.advanced(transition, semidefinite_root(noise))
        cov = transition @ state.cov @ transition.T + noise
        new = state._replace(q=q, v=v, t=state.t + dt, cov=cov, gate=state.gate.advanced(dt), noise_scale=scale)
        return new, transition @ self.root(state) if carry else None

    def _expected(self, state: EKFState, u: Float[Array, "m"], y: Array) -> Expectation:
        n, manifold = state.v.shape[0], self.model.manifold
        cov = state.cov[:n, :n] + self.measurement_cov
        return Expectation(y, manifold.towards(state.q, y), cov, self.measurement_cov, ~manifold.missing(y))

    def _velocity(self, state: EKFState) -> Velocity:
        n = state.v.shape[0]
        return Velocity(state.v, state.cov[n:, n:])

    def _usual_velocity(self, state: EKFState) -> Matrix:
        return isotropic(self.initial_velocity_std, state.v)

    def _used(self, state: EKFState, y: Array, expected: Expectation, used: Bool[Array, "n"]) -> Used:
        n = state.v.shape[0]
        present = jnp.diag(used.astype(state.v.dtype))
        # The noise of an unused entry must not affect the others, even if the two are correlated.
        apart = ~(used[:, None] & used[None, :]) & ~jnp.eye(n, dtype=bool)
        measurement_cov = jnp.where(apart, 0.0, self.measurement_cov)
        output = jnp.concatenate([present, jnp.zeros_like(present)], axis=1)
        # Both covariances are symmetric, so (S⁻¹ H P)ᵀ is the gain P Hᵀ S⁻¹.
        gain = solve(output @ state.cov @ output.T + measurement_cov, output @ state.cov).T
        error = gain @ expected.innovation
        remaining = jnp.eye(2 * n, dtype=error.dtype) - gain @ output
        # Joseph form: a sum of squares, which rounding cannot make indefinite.
        cov = remaining @ state.cov @ remaining.T + gain @ measurement_cov @ gain.T
        moved, reset = self.moved(state, error)
        return Used(moved._replace(cov=(cov + cov.T) / 2), error, reset)  # rounding makes it slightly asymmetric

    def moved(self, state: EKFState, error: Float[Array, "two_n"]) -> Moved:
        return moved(self.model, state, error)

    def root(self, state: EKFState) -> Float[Array, "two_n two_n"]:
        return semidefinite_root(state.cov)

    def with_root(self, state: EKFState, root: Float[Array, "two_n two_n"]) -> EKFState:
        return state._replace(cov=root @ root.T)

    def deviations(self, state: EKFState) -> dict[str, Vector]:
        return {"velocity_std": jnp.sqrt(jnp.diag(state.cov)[state.v.shape[0] :])}

    def _started_anew(
        self, state: EKFState, corrected: EKFState, y: Array, expected: Expectation, velocity: Velocity
    ) -> EKFState:
        n = state.v.shape[0]
        cov = self._first_cov(velocity.cov)
        cov = cov.at[:n, :n].set(with_block(state.cov[:n, :n], cov[:n, :n], expected.present))
        return corrected._replace(q=self._start(state, expected), v=velocity.mean, cov=cov)

    def _info(self, state: EKFState, new: EKFState, expected: Expectation, result: Code) -> EKFInfo:
        return ekf_info(self.model, state.q, expected, self.deviations(new), result, new.noise_scale)

    def _first_cov(self, velocity_cov: Matrix) -> Float[Array, "two_n two_n"]:
        zero = jnp.zeros_like(velocity_cov)
        return jnp.block([[self.measurement_cov, zero], [zero, velocity_cov]])


def moved(model: MechanicalSystem, state: Any, error: Float[Array, "two_n"]) -> Moved:
    """Move the estimate of a filter with the error of the EKF."""
    n = state.v.shape[0]
    q, v = model.manifold.retract(state.q, error[:n]), state.v + error[n:]
    return Moved(state._replace(q=q, v=v), jnp.eye(2 * n, dtype=error.dtype))


def ekf_info(
    model: MechanicalSystem,
    q: Array,
    expected: Expectation,
    deviations: dict[str, Vector],
    result: Code,
    scale: NoiseScale | None,
) -> EKFInfo:
    """Diagnostics of a correction, for filters with the error of the EKF."""
    _, innovation, cov, _, present, *_ = expected
    nis = normalised_square(cov, innovation, present)
    distance = model.space.norm(q, innovation)
    return EKFInfo(innovation, distance, cov, nis, **deviations, result=result, noise_scale=factor_of(scale, nis))
