"""Observers of general nonlinear systems that correct through a contraction metric, which solves a Riccati equation.

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
from covariant._typing import Code, Flag, Matrix, MatrixField, Number, Scalar, Vector
from covariant.metrics import Equation, RiccatiMetric
from covariant.models import StateSpace
from covariant.observers._protocol import AbstractFlowObserver, Held, Info, as_gain, check_finite, no_input, still
from covariant.observers._sampled import steps_for
from covariant.signals import Result


class Estimate(NamedTuple):
    """Estimated state, the time [s] it belongs to, the last finite input `held`, and the length `dt` [s] of the last
    prediction; None in continuous time."""

    x: Vector
    t: Scalar
    held: Held = None
    dt: Scalar | None = None


class Riccati(AbstractFlowObserver):
    """`x̂' = f(x̂) − 2 k_E P⁻¹ h_xᵀ R⁻¹ (h(x̂) − y)`, equation (11), with P a contraction metric at x̂.

    - `metric`: P, any `x (n,) -> (n, n)`: `metrics.RiccatiMetric` computes it along the characteristic of the estimate,
      a field designed on a grid interpolates it, and `metrics.high_gain` gives the high-gain observer.
    - `start` (n,): first estimate.
    - `gain`: k_E, a number or a function of x̂. With P from an equation with rate λ, ¼ makes the distance in P decay at
      the rate λ/2, which a smaller gain may not reach; ½ is the stationary Kalman filter.
    - `measurement_cov`: R (p, p), as in the equation of P; by default the identity.
    - `substeps`: Runge–Kutta steps of the model in each sample.

    Where the metric is not positive definite, as outside the grid of a field, the model runs without correction and
    `result` says `OUT_OF_DOMAIN`. With sampled measurements the correction is implicit: it minimises
    `|x − x̂|²_P + 2 k_E dt |h + h_x (x − x̂) − y|²`, so no gain makes it unstable, and for dt → 0 it is the differential
    equation.

    Raises `ValueError` for a gain that is not finite.
    """

    model: StateSpace
    metric: MatrixField
    start: Vector
    gain: Scalar | Callable[[Array], Array] = eqx.field(default=0.25, converter=as_gain)
    measurement_cov: Float[Array, "p p"] | None = None
    substeps: int = eqx.field(default=1, static=True)

    def __check_init__(self):
        if not callable(self.gain):
            check_finite("Riccati", gain=self.gain)

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> Estimate:
        start = jnp.asarray(self.start, y.dtype)
        t = jnp.asarray(t, y.dtype)
        return Estimate(start, t, no_input(self.model, start), jnp.zeros_like(t))

    def estimate(self, state: Estimate) -> Vector:
        return state.x

    def flow(self, t: Scalar, state: Estimate, u: Float[Array, "m"], y: Float[Array, "p"]) -> Estimate:
        x = state.x
        output_jacobian, error = _whitened_output(self.model, self.measurement_cov, t, x, u, y)
        p = self._metric(x, u)
        correction = jnp.where(_is_metric(p), 2 * self._gain(x) * solve(p, output_jacobian.T @ error), 0.0)
        slope = self.model.f(t, x, u) - correction
        return Estimate(slope, jnp.ones_like(state.t), still(state.held), still(state.dt))

    def predict(self, state: Estimate, u: Float[Array, "m"], dt: Scalar) -> Estimate:
        x = rk4(lambda s, x: self.model.f(s, x, u), state.t, state.x, dt, self.substeps)
        return state._replace(x=x, t=state.t + dt, dt=dt)

    def correct(self, state: Estimate, u: Float[Array, "m"], y: Float[Array, "p"]) -> tuple[Estimate, Info]:
        x, weight = state.x, 2 * self._gain(state.x) * state.dt
        moved, info = _correct(self.model, self.measurement_cov, state.t, x, self._metric(x, u), weight, u, y)
        return state._replace(x=moved), info

    def _gain(self, x: Vector) -> Number:
        return self.gain(x) if callable(self.gain) else self.gain

    def _metric(self, x: Vector, u: Array) -> Matrix:
        if isinstance(self.metric, RiccatiMetric) and self.model.inputs:
            # The characteristic, which runs backwards in time, is computed with the present input.
            return eqx.tree_at(lambda m: m.u, self.metric, u, is_leaf=lambda leaf: leaf is None)(x)
        return self.metric(x)


class InformationState(NamedTuple):
    """Estimated state, its information matrix P (n, n), the time [s] they belong to, the last finite input `held`, and
    the length `dt` [s] of the last prediction; None in continuous time."""

    x: Vector
    information: Matrix
    t: Scalar
    held: Held = None
    dt: Scalar | None = None


class InformationEKF(AbstractFlowObserver):
    """The extended Kalman filter in information form, equations (13)–(14): P is integrated along the estimate itself.

    - `equation`: Q and R as in the metric's equation; a rate λ makes the filter forget at that rate.
    - `start` (n,), `information` (n, n): first estimate and its information matrix, the inverse of its covariance.
    - `substeps`: Runge–Kutta steps in each sample; None takes as many as dt and the equation of P need (offline).

    Its P measures how certain the estimate is, which a constant field cannot; but nothing bounds P unless the estimate
    stays close to the state.
    """

    model: StateSpace
    equation: Equation
    start: Vector
    information: Matrix
    substeps: int | None = eqx.field(default=None, static=True)

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> InformationState:
        start, information = jnp.asarray(self.start, y.dtype), jnp.asarray(self.information, y.dtype)
        t = jnp.asarray(t, y.dtype)
        return InformationState(start, information, t, no_input(self.model, start), jnp.zeros_like(t))

    def estimate(self, state: InformationState) -> Vector:
        return state.x

    def flow(self, t: Scalar, state: InformationState, u: Float[Array, "m"], y: Float[Array, "p"]) -> InformationState:
        x, p = state.x, state.information
        output_jacobian, error = _whitened_output(self.model, self.equation.measurement_cov, t, x, u, y)
        predicted = self._unmeasured_rate(t, x, p, u)
        gathered = output_jacobian.T @ output_jacobian
        slope = self.model.f(t, x, u) - solve(p, output_jacobian.T @ error)
        return InformationState(slope, predicted + gathered, jnp.ones_like(t), still(state.held), still(state.dt))

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
        x, p, t, _, dt = state
        moved, info = _correct(self.model, self.equation.measurement_cov, t, x, p, dt, u, y)
        output_jacobian, _ = _whitened_output(self.model, self.equation.measurement_cov, t, x, u, y)
        return state._replace(x=moved, information=p + dt * output_jacobian.T @ output_jacobian), info

    def needed_substeps(self, state: InformationState, u: Array, dt: Scalar) -> Code:
        """Steps that keep h·rate ≤ 1: to first order changes of P decay at sums of two eigenvalues of `A + QP`."""
        power = jax.jacfwd(self.model.f, 1)(state.t, state.x, u)
        q = self.equation.noise(state.x)
        power = power if q is None else power + q @ state.information
        for _ in range(3):
            power = power @ power
        fastest = 2 * jnp.sqrt(jnp.sum(power * power)) ** 0.125 + self.equation.rate
        return steps_for(dt, fastest)

    def _unmeasured_rate(self, t: Scalar, x: Vector, p: Matrix, u: Array) -> Matrix:
        """Time derivative of P without measurements."""
        a = jax.jacfwd(self.model.f, 1)(t, x, u)
        q = self.equation.noise(x)
        loss = self.equation.rate * p + (0.0 if q is None else p @ q @ p)
        return -p @ a - a.T @ p - loss


def _is_metric(p: Matrix) -> Flag:
    """Whether p is positive definite; where it is not, or not finite, there is no correction."""
    return jnp.all(pivots(p) > 0)


def _whitened_output(
    model: StateSpace, measurement_cov: Float[Array, "p p"] | None, t, x: Vector, u: Array, y: Array
) -> tuple[Array, Array]:
    """`R^{-1/2} h_x` and `R^{-1/2} (h − y)`, both with zeros for the outputs that are missing (NaN)."""
    missing = jnp.isnan(y)
    error = model.output_error(model.h(t, x, u), y)
    jacobian: Array = jax.jacfwd(model.h, 1)(t, x, u)
    output_jacobian: Array = jnp.where(missing[:, None], 0.0, jacobian)
    if measurement_cov is None:
        return output_jacobian, error
        # The noise of a missing output must not affect the others, even where the two are correlated.
    apart = (missing[:, None] | missing[None, :]) & ~jnp.eye(y.shape[0], dtype=bool)
    cov = jnp.where(apart, 0.0, jnp.asarray(measurement_cov, x.dtype))
    both = half_solve(cov, jnp.concatenate([output_jacobian, error[:, None]], axis=1))
    return both[:, :-1], both[:, -1]


def _correct(
    model: StateSpace,
    measurement_cov: Float[Array, "p p"] | None,
    t,
    x: Vector,
    p: Matrix,
    weight: Number,
    u: Array,
    y: Array,
) -> tuple[Vector, Info]:
    """Correct by y: `x − (P + w h_xᵀ R⁻¹ h_x)⁻¹ w h_xᵀ R⁻¹ (h − y)`, with w the `weight`."""
    output_jacobian, error = _whitened_output(model, measurement_cov, t, x, u, y)
    correction = solve(p + weight * output_jacobian.T @ output_jacobian, weight * output_jacobian.T @ error)
    positive = _is_metric(p)
    correction = jnp.where(positive, correction, 0.0)
    moved = x - correction
    result = jnp.where(
        ~jnp.all(jnp.isfinite(moved)),
        int(Result.NOT_FINITE),
        jnp.where(
            jnp.all(jnp.isnan(y)), int(Result.COASTED), jnp.where(positive, int(Result.OK), int(Result.OUT_OF_DOMAIN))
        ),
    )
    square = jnp.where(positive, correction @ jnp.where(jnp.isfinite(p), p, 0.0) @ correction, 0.0)
    distance = jnp.sqrt(jnp.maximum(square, 0.0))
    return moved, Info(-model.output_error(model.h(t, x, u), y), distance, result.astype(jnp.int32))
