"""Extended Kalman filter of a state-space model in covariance form, with sampled measurements and a gate.

Source: Gelb 1974, Applied Optimal Estimation, section 6.1; Joseph form of the covariance update.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._integrate import rk4
from covariant._linalg import semidefinite_root, solve
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.geometry import AbstractManifold
from covariant.models import StateSpace
from covariant.observers.base import (
    Gate,
    GateMemory,
    Judged,
    LastInput,
    Velocity,
    check_finite,
    no_input,
    normalised_square,
    steps_for,
)
from covariant.observers.filters._gated_filter import AbstractGatedFilter, Expectation, Moved, Used
from covariant.signals import StepCode


class StateEKFState(NamedTuple):
    """State of a `StateEKF`: the estimate, its covariance, and the memory of the gate.

    Attributes:
        x: Estimated state (n,).
        t: Time [s] of the estimate.
        cov: Covariance (n, n) of the estimate.
        gate: Memory of the gate.
        last_input: Last finite input (m,), which replaces an input that is not finite; None if none is stored.

    Example:
        >>> import jax
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> start = np.array([1.0, 0.0])
        >>> ekf = observers.StateEKF(models.duffing(), np.eye(2), np.array([[1e-4]]), start, np.eye(2))
        >>> jax.jit(lambda y: ekf.init(y).x)(np.array([1.2])).round(3).tolist()  # the measurement corrects the start
        [1.2, 0.0]
    """

    x: Vector
    t: Scalar
    cov: Matrix
    gate: GateMemory
    last_input: LastInput = None


class StateEKFInfo(NamedTuple):
    """Diagnostics of a step of a `StateEKF`.

    Attributes:
        innovation: Measured minus predicted outputs (p,), 0 where missing.
        distance: Square root of `nis`.
        innovation_cov: Predicted covariance (p, p) of the innovation.
        nis: Normalised innovation squared, `rᵀS⁻¹r` of the measured outputs.
        state_std: Standard deviations (n,) of the state after the correction.
        result: A `covariant.signals.StepCode` code.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, StepCode, models, observers
        >>> start = np.array([1.0, 0.0])
        >>> ekf = observers.StateEKF(models.duffing(), np.eye(2), np.array([[1e-4]]), start, np.eye(2), substeps=1)
        >>> record = Record(np.array([0.0, 0.01]), np.zeros((2, 1)), np.array([[1.0], [np.nan]]))
        >>> run = observers.run(ekf, record)
        >>> run.info.nis[1].item(), StepCode(run.info.result[1].item()).name
        (0.0, 'COASTED')
    """

    innovation: Vector
    distance: Scalar
    innovation_cov: Matrix
    nis: Scalar
    state_std: Vector
    result: Code


class StateEKF(AbstractGatedFilter):
    """Extended Kalman filter of `x' = f(t, x, u)`, `y = h(t, x, u)`, linearised along the integrated model.

    It is the default filter of state-space models, and reports how certain each state is. It needs a first estimate
    with its covariance, and is reliable only while errors are small enough for a linearisation. Use `Contracting` or
    `Riccati` if convergence should follow from a metric, and `EKF` or `IntrinsicKalman` for a mechanical system.

    Attributes:
        model: State-space model with n states, m inputs and p outputs.
        process_cov: Spectral density (n, n) of the white noise in f [(unit of x)²/s].
        measurement_cov: Covariance (p, p) of one sample of the outputs [(unit of y)²].
        start: First estimate (n,), before the first measurement.
        start_cov: Covariance (n, n) of the first estimate [(unit of x)²].
        substeps: Runge–Kutta steps in each sample; None (default) uses as many as dt and the model need (offline).
        gate: Gate that refuses outputs as outliers; None refuses nothing. See `Gate`.

    Raises:
        ValueError: A covariance or the start is not finite.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> start = np.array([0.9, 0.0])
        >>> ekf = observers.StateEKF(models.duffing(), np.eye(2), np.array([[1e-4]]), start, np.eye(2), substeps=1)
        >>> record = Record(np.array([0.0, 0.01]), np.zeros((2, 1)), np.array([[1.0], [1.0]]))
        >>> run = observers.run(ekf, record)
        >>> bool(np.allclose(run.estimate[1], [1.0, 0.0], atol=1e-3))  # at rest in the well
        True
    """

    model: StateSpace
    process_cov: Matrix
    measurement_cov: Float[Array, "p p"]
    start: Vector
    start_cov: Matrix
    substeps: int | None = eqx.field(default=None, static=True)
    gate: Gate | None = Gate()

    def __check_init__(self):
        check_finite(
            "StateEKF",
            process_cov=self.process_cov,
            measurement_cov=self.measurement_cov,
            start=self.start,
            start_cov=self.start_cov,
        )

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> StateEKFState:
        """State at the start: the first estimate, corrected by the first measurement.

        Args:
            y: Measured outputs (p,), NaN where missing.
            t: Time [s].

        Returns:
            The state, with a zero input as the last one.
        """
        start, cov = jnp.asarray(self.start, y.dtype), jnp.asarray(self.start_cov, y.dtype)
        gate = GateMemory.at_start(jnp.zeros_like(y))
        u = no_input(self.model, start)
        return self.correct(StateEKFState(start, jnp.asarray(t, y.dtype), cov, gate, u), u, y)[0]

    def estimate(self, state: StateEKFState) -> Vector:
        return state.x

    def _predicted(
        self, state: StateEKFState, u: Float[Array, "m"], dt: Scalar, carry: bool
    ) -> tuple[StateEKFState, Matrix | None]:
        count = self.needed_substeps(state, u, dt) if self.substeps is None else self.substeps

        def ahead(x):
            x_new = rk4(lambda s, x: self.model.f(s, x, u), state.t, x, dt, count)
            return x_new, x_new

        transition, x = jax.jacfwd(ahead, has_aux=True)(state.x)
        # Simpson's rule for the contribution of white noise; the mean of both ends is the transition over half a step.
        half = (jnp.eye(len(x), dtype=x.dtype) + transition) / 2
        density = jnp.asarray(self.process_cov, x.dtype)
        added = density + 4 * half @ density @ half.T + transition @ density @ transition.T
        cov = transition @ state.cov @ transition.T + dt / 6 * added
        new = state._replace(x=x, t=state.t + dt, cov=cov, gate=state.gate.advanced(dt))
        return new, transition @ self.root(state) if carry else None

    @property
    def _manifold(self) -> AbstractManifold:
        return self.model.manifold

    def _expected(self, state: StateEKFState, u: Float[Array, "m"], y: Float[Array, "p"]) -> Expectation:
        x = state.x
        slope: Array = jax.jacfwd(self.model.h, 1)(state.t, x, u)
        # `output_error` is predicted minus measured; an innovation has the opposite sign.
        innovation = -self.model.output_error(self.model.h(state.t, x, u), y)
        noise = jnp.asarray(self.measurement_cov, x.dtype)
        return Expectation(y, innovation, slope @ state.cov @ slope.T + noise, noise, ~jnp.isnan(y), details=slope)

    def _velocity(self, state: StateEKFState) -> Velocity:
        return Velocity(jnp.zeros_like(state.gate.left), jnp.zeros((0, 0)))  # outputs do not show a velocity

    def _usual_velocity(self, state: StateEKFState) -> None:
        return None

    def _used(self, state: StateEKFState, y: Float[Array, "p"], expected: Expectation, used: Bool[Array, "p"]) -> Used:
        x, noise = state.x, expected.noise
        slope: Array = expected.details
        # The noise of an unused output must not affect the others, even if the two are correlated.
        noise = jnp.where(used[:, None] & used[None, :], noise, jnp.eye(len(y), dtype=x.dtype))
        output: Array = jnp.where(used[:, None], slope, 0.0)
        gain = solve(output @ state.cov @ output.T + noise, output @ state.cov).T
        remaining = jnp.eye(len(x), dtype=x.dtype) - gain @ output
        # Joseph form: a sum of squares, which rounding cannot make indefinite.
        cov = remaining @ state.cov @ remaining.T + gain @ noise @ gain.T
        error = gain @ jnp.where(used, expected.innovation, 0.0)
        moved, reset = self.moved(state, error)
        return Used(moved._replace(cov=(cov + cov.T) / 2), error, reset)

    def moved(self, state: StateEKFState, error: Vector) -> Moved:
        return Moved(state._replace(x=state.x + error), jnp.eye(len(error), dtype=error.dtype))

    def root(self, state: StateEKFState) -> Matrix:
        return semidefinite_root(state.cov)

    def with_root(self, state: StateEKFState, root: Matrix) -> StateEKFState:
        return state._replace(cov=root @ root.T)

    def deviations(self, state: StateEKFState) -> dict[str, Vector]:
        return {"state_std": jnp.sqrt(jnp.diag(state.cov))}

    def _started_anew(
        self,
        state: StateEKFState,
        corrected: StateEKFState,
        y: Float[Array, "p"],
        expected: Expectation,
        velocity: Velocity,
    ) -> StateEKFState:
        # Outputs alone do not determine a state, so the estimate stays, with its initial covariance.
        return corrected._replace(cov=jnp.asarray(self.start_cov, state.x.dtype))

    def _result(
        self, state: StateEKFState, new: StateEKFState, y: Float[Array, "p"], expected: Expectation, verdict: Judged
    ) -> Code:
        code = jnp.where(jnp.any(expected.present), int(StepCode.OK), int(StepCode.COASTED)).astype(jnp.int32)
        finite = jnp.all(jnp.isfinite(new.x)) & jnp.all(jnp.isfinite(new.cov))
        return jnp.where(finite, verdict.result(code), int(StepCode.NOT_FINITE)).astype(jnp.int32)

    def _info(self, state: StateEKFState, new: StateEKFState, expected: Expectation, result: Code) -> StateEKFInfo:
        _, innovation, cov, _, present, *_ = expected
        nis = normalised_square(cov, innovation, present)
        return StateEKFInfo(innovation, jnp.sqrt(nis), cov, nis, **self.deviations(new), result=result)

    def advance(
        self, state: StateEKFState, u: Float[Array, "m"], y: Float[Array, "p"], dt: Scalar
    ) -> tuple[StateEKFState, StateEKFInfo]:
        """Predict and correct, as every observer does.

        Args:
            state: State after the previous sample.
            u: Input (m,), finite, constant over the step.
            y: Measured outputs (p,), NaN where missing.
            dt: Length of the step [s], finite and ≥ 0.

        Returns:
            The new state and the info; if dt is zero, its `state_std` is that of the old state.
        """
        new, info = self.correct(self.predict(state, u, dt), u, y)
        before = self.deviations(state)["state_std"]  # a repeated stamp changes nothing
        return new, info._replace(state_std=jnp.where(dt > 0, info.state_std, before))

    def needed_substeps(self, state: StateEKFState, u: Array, dt: Scalar) -> Code:
        """Number of Runge–Kutta steps that keep h·rate ≤ 1, with a bound on the eigenvalues of ∂f/∂x.

        Args:
            state: State at the start of the step.
            u: Input (m,), constant over the step.
            dt: Length of the step [s].

        Returns:
            The number of steps of length h, with twice the bound on the largest eigenvalue at the start as the rate.
        """
        power = jax.jacfwd(self.model.f, 1)(state.t, state.x, u)
        # The Frobenius norm of A⁸, to the power ⅛, is a close upper bound of the spectral radius of A.
        for _ in range(3):
            power = power @ power
        return steps_for(dt, 2 * jnp.sqrt(jnp.sum(power * power)) ** 0.125)
