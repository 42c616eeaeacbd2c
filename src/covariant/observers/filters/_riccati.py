"""Observers of general nonlinear systems whose correction uses a contraction metric that solves a Riccati equation.

Source: Sanfelice & Praly 2015, equations (3), (11) and (13)–(14).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._integrate import rk4
from covariant._linalg import half_solve, pivots, solve
from covariant._typing import Code, Flag, Matrix, Number, Scalar, StateField, Vector
from covariant.metrics import Equation, RiccatiMetric, with_time
from covariant.models import StateSpace
from covariant.observers.base import (
    AbstractFlowObserver,
    Info,
    LastInput,
    as_gain,
    check_finite,
    no_input,
    step_length,
    steps_for,
    still,
)
from covariant.signals import StepCode


class Estimate(NamedTuple):
    """State of a `Riccati` observer.

    Attributes:
        x: Estimated state (n,).
        t: Time [s] of the estimate.
        last_input: The last finite input (m,); None in continuous time.
        dt: Length [s] of the last prediction; None in continuous time.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import observers
        >>> state = observers.Estimate(x=jnp.ones(2), t=jnp.zeros(()))
        >>> state.last_input is None, state.dt is None
        (True, True)
    """

    x: Vector
    t: Scalar
    last_input: LastInput = None
    dt: Scalar | None = None


class Riccati(AbstractFlowObserver):
    """Observer `x̂' = f(x̂) − 2 k_E P⁻¹ h_xᵀ R⁻¹ (h(x̂) − y)`, equation (11), with P a contraction metric at x̂.

    With sampled measurements the correction is implicit: it minimises `|x − x̂|²_P + 2 k_E dt |h + h_x (x − x̂) − y|²`,
    so no gain makes it unstable, and for dt → 0 it becomes the differential equation. If the metric is not positive
    definite, as outside the grid of a field, the model runs without correction and `result` says `OUT_OF_DOMAIN`.

    Its gain depends on the present estimate only, while the gain of `StateEKF` depends on all earlier ones. Take the
    metric from `metrics.RiccatiMetric`, `metrics.load_metric` or `metrics.high_gain`.

    Attributes:
        model: The system, with n states and p outputs.
        metric: P, any function `x (n,) -> (n, n)` or `(t, x) -> (n, n)`: `metrics.RiccatiMetric` computes it along the
            characteristic of the estimate, a field designed on a grid interpolates it, `metrics.high_gain` gives the
            high-gain observer, and `certificates.tangent_metric` lifts a kinetic-energy metric.
        start: First estimate (n,).
        gain: k_E, a number or a function of x̂; ¼ by default. With P from an equation with rate λ, ¼ makes the distance
            in P decay at the rate λ/2, which a smaller gain may not reach; ½ is the stationary Kalman filter.
        measurement_cov: R (p, p), as in the equation of P; None (default) is the identity.
        substeps: Number of Runge–Kutta steps of the model in each sample, 1 by default.

    Raises:
        ValueError: The gain is not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> tank = models.StateSpace(lambda t, x, u: -2.0 * x, lambda t, x, u: x, coordinates=("level",), units=("m",))
        >>> observer = observers.Riccati(tank, lambda x: 0.5 * jnp.eye(1), start=jnp.array([1.0]))
        >>> state = observers.Estimate(jnp.array([1.0]), jnp.zeros(()))
        >>> observer.flow(state.t, state, jnp.zeros(0), jnp.array([1.5])).x.round(6).tolist()  # −2 + 2 · ¼ · 2 · 0.5
        [-1.5]
    """

    model: StateSpace
    metric: StateField
    start: Vector
    gain: Scalar | Callable[[Array], Array] = eqx.field(default=0.25, converter=as_gain)
    measurement_cov: Float[Array, "p p"] | None = None
    substeps: int = eqx.field(default=1, static=True)

    def __check_init__(self):
        if not callable(self.gain):
            check_finite("Riccati", gain=self.gain)

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> Estimate:
        """State at the first estimate `start`.

        Args:
            y: First measurement (p,); only its precision is used.
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.
        """
        start = jnp.asarray(self.start, y.dtype)
        t = jnp.asarray(t, y.dtype)
        return Estimate(start, t, no_input(self.model, start), jnp.zeros_like(t))

    def estimate(self, state: Estimate) -> Vector:
        return state.x

    def flow(self, t: Scalar, state: Estimate, u: Float[Array, "m"], y: Float[Array, "p"]) -> Estimate:
        x = state.x
        output = _output(self.model, self.measurement_cov, t, x, u, y)
        p = self._metric(t, x, u)
        correction = jnp.where(_is_metric(p), 2 * self._gain(x) * solve(p, output.jacobian.T @ output.error), 0.0)
        slope = self.model.f(t, x, u) - correction
        return Estimate(slope, jnp.ones_like(state.t), still(state.last_input), still(state.dt))

    def predict(self, state: Estimate, u: Float[Array, "m"], dt: Scalar) -> Estimate:
        x = rk4(lambda s, x: self.model.f(s, x, u), state.t, state.x, dt, self.substeps)
        return state._replace(x=x, t=state.t + dt, dt=dt)

    def correct(self, state: Estimate, u: Float[Array, "m"], y: Float[Array, "p"]) -> tuple[Estimate, Info]:
        """Correct a predicted state by the implicit formula; a missing output is left out.

        Args:
            state: State that `predict` returned, whose `dt` [s] weights the correction.
            u: Input (m,) that acted over the prediction.
            y: Measurement (p,), NaN where missing.

        Returns:
            The corrected state, and the info, whose distance is the length of the correction in the metric P.
        """
        x, weight = state.x, 2 * self._gain(state.x) * step_length(state)
        output = _output(self.model, self.measurement_cov, state.t, x, u, y)
        corrected, info = _correct(x, self._metric(state.t, x, u), weight, output)
        return state._replace(x=corrected), info

    def _gain(self, x: Vector) -> Number:
        return self.gain(x) if callable(self.gain) else self.gain

    def _metric(self, t: Scalar, x: Vector, u: Array) -> Matrix:
        if isinstance(self.metric, RiccatiMetric) and self.model.inputs:
            # The characteristic, which runs backward in time, is computed with the present input.
            return eqx.tree_at(lambda m: m.u, self.metric, u, is_leaf=lambda leaf: leaf is None)(x)
        return with_time(self.metric)(t, x)


class InformationState(NamedTuple):
    """State of an `InformationEKF`.

    Attributes:
        x: Estimated state (n,).
        information: Its information matrix P (n, n), the inverse of its covariance.
        t: Time [s] of the estimate.
        last_input: The last finite input (m,); None in continuous time.
        dt: Length [s] of the last prediction; None in continuous time.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.observers.filters import InformationState
        >>> state = InformationState(x=jnp.ones(2), information=4.0 * jnp.eye(2), t=jnp.zeros(()))
        >>> jnp.linalg.inv(state.information).diagonal().tolist()  # variances
        [0.25, 0.25]
    """

    x: Vector
    information: Matrix
    t: Scalar
    last_input: LastInput = None
    dt: Scalar | None = None


class InformationEKF(AbstractFlowObserver):
    """Extended Kalman filter in information form, equations (13)–(14): P is integrated along the estimate itself.

    Its P measures how certain the estimate is, which a constant field cannot. However, P is bounded only if the
    estimate stays close to the state.

    Attributes:
        model: The system, with n states and p outputs.
        equation: Q and R as in the metric's equation; a rate λ makes the filter forget at that rate.
        start: First estimate (n,).
        information: Information matrix (n, n) of the first estimate, the inverse of its covariance.
        substeps: Number of Runge–Kutta steps in each sample; None (default) uses as many as dt and the equation of P
            need (offline).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import metrics, models, observers
        >>> constant = models.StateSpace(
        ...     lambda t, x, u: 0.0 * x, lambda t, x, u: x, coordinates=("level",), units=("m",)
        ... )
        >>> equation = metrics.Equation(process_cov=jnp.zeros((1, 1)))
        >>> observer = observers.InformationEKF(constant, equation, jnp.zeros(1), 2.0 * jnp.eye(1), substeps=1)
        >>> state = observer.init(jnp.array([1.0]))
        >>> state, info = observer.step(state, jnp.zeros(0), jnp.array([1.0]), 0.5)
        >>> state.information.round(6).tolist()  # 2 + dt/R
        [[2.5]]
    """

    model: StateSpace
    equation: Equation
    start: Vector
    information: Matrix
    substeps: int | None = eqx.field(default=None, static=True)

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> InformationState:
        """State at the first estimate `start` and its information matrix.

        Args:
            y: First measurement (p,); only its precision is used.
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.
        """
        start, information = jnp.asarray(self.start, y.dtype), jnp.asarray(self.information, y.dtype)
        t = jnp.asarray(t, y.dtype)
        return InformationState(start, information, t, no_input(self.model, start), jnp.zeros_like(t))

    def estimate(self, state: InformationState) -> Vector:
        return state.x

    def flow(self, t: Scalar, state: InformationState, u: Float[Array, "m"], y: Float[Array, "p"]) -> InformationState:
        x, p = state.x, state.information
        output = _output(self.model, self.equation.measurement_cov, t, x, u, y)
        predicted = self._unmeasured_rate(t, x, p, u)
        gain = output.jacobian.T @ output.jacobian
        slope = self.model.f(t, x, u) - solve(p, output.jacobian.T @ output.error)
        return InformationState(slope, predicted + gain, jnp.ones_like(t), still(state.last_input), still(state.dt))

    def predict(self, state: InformationState, u: Float[Array, "m"], dt: Scalar) -> InformationState:
        def flow(s, joint):
            x, p = joint
            return self.model.f(s, x, u), self._unmeasured_rate(s, x, p, u)

        count = self.needed_substeps(state, u, dt) if self.substeps is None else self.substeps
        x, p = rk4(flow, state.t, (state.x, state.information), dt, count)
        return state._replace(x=x, information=p, t=state.t + dt, dt=dt)

    def correct(
        self, state: InformationState, u: Float[Array, "m"], y: Float[Array, "p"]
    ) -> tuple[InformationState, Info]:
        """Correct a predicted state, and add the information of the measured outputs; a missing one is left out.

        Args:
            state: State that `predict` returned, whose `dt` [s] weights the correction.
            u: Input (m,) that acted over the prediction.
            y: Measurement (p,), NaN where missing.

        Returns:
            The corrected state, and the info, whose distance is the length of the correction in P before the
            measurement.
        """
        (x, p, t), dt = state[:3], step_length(state)
        output = _output(self.model, self.equation.measurement_cov, t, x, u, y)
        corrected, info = _correct(x, p, dt, output)
        # A sample represents a continuous measurement over dt, whose information is dt h_xᵀ R⁻¹ h_x.
        return state._replace(x=corrected, information=p + dt * output.jacobian.T @ output.jacobian), info

    def needed_substeps(self, state: InformationState, u: Array, dt: Scalar) -> Code:
        """Number of Runge–Kutta steps that keep h·rate ≤ 1.

        To first order, changes of P decay at sums of two eigenvalues of `A + QP`.

        Args:
            state: State of this filter.
            u: Input (m,).
            dt: Length of the prediction [s].

        Returns:
            The number of steps.
        """
        power = jax.jacfwd(self.model.f, 1)(state.t, state.x, u)
        q = self.equation.noise(state.x)
        power = power if q is None else power + q @ state.information
        # The norm of the 8th power, to the power ⅛, is a close upper bound of the spectral radius; the factor 2 is for
        # sums of two eigenvalues.
        for _ in range(3):
            power = power @ power
        fastest = 2 * jnp.sqrt(jnp.sum(power * power)) ** 0.125 + self.equation.rate
        return steps_for(dt, fastest)

    def _unmeasured_rate(self, t: Scalar, x: Vector, p: Matrix, u: Array) -> Matrix:
        """Time derivative of P without measurements."""
        a = jax.jacfwd(self.model.f, 1)(t, x, u)
        q = self.equation.noise(x)
        loss = self.equation.rate * p + (0.0 if q is None else p @ q @ p)
        # P is an inverse covariance: C' = AC + CAᵀ + Q implies P' = −P C' P.
        return -p @ a - a.T @ p - loss


def _is_metric(p: Matrix) -> Flag:
    """Whether p is positive definite; if it is not, or not finite, there is no correction."""
    # p is positive definite if and only if all pivots of the elimination are positive; NaN compares as false.
    return jnp.all(pivots(p) > 0)


class _Output(NamedTuple):
    """An output compared with its measurement, whitened, with zeros for missing entries.

    Attributes:
        innovation: `y − h` (p,), not whitened, with zeros where missing.
        missing: Which entries of the measurement are missing (p,).
        jacobian: `R^{-1/2} h_x` (p, n).
        error: `R^{-1/2} (h − y)` (p,).
    """

    innovation: Array
    missing: Array
    jacobian: Array
    error: Array


def _output(
    model: StateSpace, measurement_cov: Float[Array, "p p"] | None, t, x: Vector, u: Array, y: Array
) -> _Output:
    """The output of the model at x, compared with the measurement y, NaN where missing."""
    missing = jnp.isnan(y)
    error = model.output_error(model.h(t, x, u), y)
    jacobian: Array = jax.jacfwd(model.h, 1)(t, x, u)
    output_jacobian: Array = jnp.where(missing[:, None], 0.0, jacobian)
    if measurement_cov is None:
        return _Output(-error, missing, output_jacobian, error)
    # The noise of a missing output must not affect the others, even if the two are correlated.
    uncoupled = (missing[:, None] | missing[None, :]) & ~jnp.eye(y.shape[0], dtype=bool)
    cov = jnp.where(uncoupled, 0.0, jnp.asarray(measurement_cov, x.dtype))
    whitened = half_solve(cov, jnp.concatenate([output_jacobian, error[:, None]], axis=1))
    return _Output(-error, missing, whitened[:, :-1], whitened[:, -1])


def _correct(x: Vector, p: Matrix, weight: Number, output: _Output) -> tuple[Vector, Info]:
    """Correct by y: `x − (P + w h_xᵀ R⁻¹ h_x)⁻¹ w h_xᵀ R⁻¹ (h − y)`, with w the `weight`."""
    jacobian = output.jacobian
    # The minimum of |δ|_P² + w |h − y + h_x δ|²; the matrix is positive definite if P is, for any rank of h_x.
    correction = solve(p + weight * jacobian.T @ jacobian, weight * jacobian.T @ output.error)
    positive = _is_metric(p)
    correction = jnp.where(positive, correction, 0.0)
    corrected = x - correction
    faults = ~jnp.all(jnp.isfinite(corrected)), jnp.all(output.missing), ~positive
    codes = (StepCode.NOT_FINITE, StepCode.COASTED, StepCode.OUT_OF_DOMAIN)
    result = jnp.select(faults, [jnp.asarray(int(code)) for code in codes], int(StepCode.OK))
    # Zero times infinity is NaN, so entries of p that are not finite are replaced first.
    square = jnp.where(positive, correction @ jnp.where(jnp.isfinite(p), p, 0.0) @ correction, 0.0)
    distance = jnp.sqrt(jnp.maximum(square, 0.0))
    return corrected, Info(output.innovation, distance, result.astype(jnp.int32))
