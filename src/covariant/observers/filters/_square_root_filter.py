"""Kalman filter of the errors of configuration and velocity in the frame of the space, but for its prediction.

The error is `(local(q̂, q), v − v̂)`, of which a measured configuration shows the first half, `local(q̂, y)`. The filter
stores a square root of its covariance, which rounding cannot make indefinite.

Source: Kailath, Sayed & Hassibi 2000, Linear Estimation, chapter 12, for the square root; Bar-Shalom, Li & Kirubarajan
2001, section 5.4, for the gate.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Inexact

from covariant._linalg import semidefinite_root
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.observers.base import (
    Covariance,
    GateMemory,
    LastInput,
    Velocity,
    at_rest,
    check_covariance,
    check_finite,
    check_free,
    covariance_at,
    diagonal,
    isotropic,
    normalised_square,
    updated,
    with_block,
)
from covariant.observers.filters._gated_filter import AbstractMechanicalFilter, Expectation, Moved, Used
from covariant.observers.filters._noise_scale import NoiseScale, factor_of


class SquareRootState(NamedTuple):
    """State of an `EKF` or a `UKF`: the estimate, a square root of its covariance, and the memory of the gate.

    Attributes:
        q: Estimated configuration q̂: coordinates (n,), or a group element (N, N).
        v: Estimated velocity v̂ (n,) in the frame of the space.
        t: Time [s] of the estimate.
        root: Square root S (2n, 2n) of the covariance `S Sᵀ` of the error `(local(q̂, q), v − v̂)`.
        gate: Memory of the gate.
        last_input: Last finite input (m,), which replaces an input that is not finite; None if none is stored.
        noise_scale: Learnt size of the unknown noise, and its sensitivities; None if the filter is not adaptive.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> ukf = observers.UKF(models.oscillator(), 1.0, 1e-4, initial_velocity_std=2.0)
        >>> ukf.init(np.array([0.1])).root.round(6).tolist()
        [[0.01, 0.0], [0.0, 2.0]]
    """

    q: Inexact[Array, "..."]
    v: Vector
    t: Scalar
    root: Float[Array, "two_n two_n"]
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


class AbstractSquareRootFilter(AbstractMechanicalFilter):
    """Kalman filter of configuration and velocity; a subclass has its fields, and predicts."""

    process_cov: eqx.AbstractVar[Covariance]
    measurement_cov: eqx.AbstractVar[Covariance]
    initial_velocity_std: eqx.AbstractVar[Scalar | Vector]
    adaptive: eqx.AbstractVar[bool]

    def __check_init__(self):
        whose = type(self).__name__
        check_covariance(whose, "process_cov", self.process_cov)
        check_covariance(whose, "measurement_cov", self.measurement_cov, positive=True)
        check_finite(whose, initial_velocity_std=self.initial_velocity_std)
        check_free(whose, self.model)

    def init(self, y: Array, t: Number = 0.0) -> SquareRootState:
        q, v, t, last_input, _ = at_rest(self.model, y, t)
        root = self._first_root(q, isotropic(self.initial_velocity_std, v))
        scale = NoiseScale.at_start(root) if self.adaptive else None
        return SquareRootState(q, v, t, root, GateMemory.at_start(v), last_input, scale)

    def _expected(self, state: SquareRootState, u: Float[Array, "m"], y: Array) -> Expectation:
        manifold, n = self.model.manifold, state.v.shape[0]
        noise = covariance_at(self.measurement_cov, self.model.space, state.q)
        cov = state.root[:n] @ state.root[:n].T + noise
        return Expectation(y, manifold.towards(state.q, y), cov, noise, ~manifold.missing(y))

    def _usual_velocity(self, state: SquareRootState) -> Matrix:
        return isotropic(self.initial_velocity_std, state.v)

    def _used(self, state: SquareRootState, y: Array, expected: Expectation, used: Bool[Array, "n"]) -> Used:
        n = state.v.shape[0]
        gain, root = updated(state.root, state.root[:n], expected.noise, used)
        error = gain @ expected.innovation
        new, reset = self.moved(state, error)
        return Used(new._replace(root=root), error, reset)

    def moved(self, state: SquareRootState, error: Float[Array, "two_n"]) -> Moved:
        n = state.v.shape[0]
        q, v = self.model.manifold.retract(state.q, error[:n]), state.v + error[n:]
        return Moved(state._replace(q=q, v=v), jnp.eye(2 * n, dtype=error.dtype))

    def deviations(self, state: SquareRootState) -> dict[str, Vector]:
        return {"velocity_std": jnp.sqrt(jnp.sum(state.root[state.v.shape[0] :] ** 2, axis=1))}

    def _started_anew(
        self, state: SquareRootState, corrected: SquareRootState, y: Array, expected: Expectation, velocity: Velocity
    ) -> SquareRootState:
        q, n = self._start(state, expected), state.v.shape[0]
        root = self._first_root(q, velocity.cov)
        predicted, measured = (a[:n] @ a[:n].T for a in (state.root, root))
        position = semidefinite_root(with_block(predicted, measured, expected.present))
        return corrected._replace(q=q, v=velocity.mean, root=root.at[:n, :n].set(position))

    def _info(self, state: SquareRootState, new: SquareRootState, expected: Expectation, result: Code) -> EKFInfo:
        _, innovation, cov, _, present, *_ = expected
        nis = normalised_square(cov, innovation, present)
        distance, scale = self.model.space.norm(state.q, innovation), factor_of(new.noise_scale, nis)
        return EKFInfo(innovation, distance, cov, nis, **self.deviations(new), result=result, noise_scale=scale)

    def _first_root(self, q: Array, velocity_cov: Matrix) -> Float[Array, "two_n two_n"]:
        position = semidefinite_root(covariance_at(self.measurement_cov, self.model.space, q))
        return diagonal(position.astype(velocity_cov.dtype), semidefinite_root(velocity_cov))
