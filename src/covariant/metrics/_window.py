"""Represents a window of the past by its action on metrics (Redheffer's scattering form of the Riccati equation).

Let Φ, W, V describe the window [−s, 0] of the solution through x: a metric π at its beginning becomes the metric

    P = W + Φᵀ (π⁻¹ + V)⁻¹ Φ

at its end. Φ, W and V obey differential equations in s, which are integrated backward together with the solution. So
one pass computes P, and at every s it bounds how much the unknown π can still change P.

Source: Redheffer 1962, On the relation of transmission-line theory to scattering and transfer, J. Math. and Phys. 41.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._integrate import rk4
from covariant._linalg import cholesky, pivots, solve
from covariant._typing import Matrix, Number, Scalar, Vector
from covariant.metrics._equation import Equation, check_state, coefficients, model_input
from covariant.models import StateSpace

MARGIN = 10.0
"""Assumed largest ratio of the metric before the window to the metric of the window, if Q gives no bound."""


class Window(NamedTuple):
    """A window of the past that ends at a given state, by its action on metrics (Redheffer's scattering form).

    A metric π at its beginning becomes `P = W + Φᵀ (π⁻¹ + V)⁻¹ Φ` at its end.

    Attributes:
        x: state (n,) at its beginning.
        transition: Φ (n, n).
        information: W (n, n).
        spread: V (n, n); None if the equation has no Q, so that V is zero.

    Example:
        A window without length leaves a metric unchanged:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics._window import Window
        >>> window = Window(jnp.zeros(1), transition=jnp.eye(1), information=jnp.zeros((1, 1)), spread=None)
        >>> window.metric(4.0).tolist()
        [[4.0]]
    """

    x: Vector
    transition: Matrix
    information: Matrix
    spread: Matrix | None

    def metric(self, start: Number | Matrix) -> Matrix:
        """Metric P at the end of the window.

        Args:
            start: metric at its beginning, a matrix (n, n) or a multiple of I.

        Returns:
            Matrix (n, n).
        """
        return self.information + self._propagate(start)

    def error_bound(self, start: Number | Matrix) -> Scalar:
        """Bound on the affine-invariant distance between any two metrics that the unknown past allows.

        With a positive Q it holds for every past. Without Q, the metric at the beginning is assumed to be at most
        `MARGIN` times W, or at most `start`.

        Args:
            start: metric at the beginning of the window, a matrix (n, n) or a multiple of I.

        Returns:
            The bound, a scalar; NaN if the window is too short.
        """
        known = jnp.all(pivots(self.information) > 0)
        if self.spread is None:
            # Without Q nothing bounds π, so it is assumed to be at most `MARGIN` times W, or at most `start` if that is
            # larger.
            before = MARGIN * self.transition.T @ self.information @ self.transition
            most = jnp.maximum(self._distance_bound(before), self._distance_bound(self._propagate(start)))
        else:
            # If Q is singular, V becomes positive definite only as the window grows; before that it gives no bound.
            known = known & jnp.all(pivots(self.spread) > 0)
            # (π⁻¹ + V)⁻¹ ≤ V⁻¹ for every π, so this bounds the contribution of any past to W.
            most = self._distance_bound(self.transition.T @ solve(self.spread, self.transition))
        return jnp.where(known, most, jnp.nan)

    def _distance_bound(self, addition: Matrix) -> Scalar:
        """Bound Σ μ on the distance √(Σ log²(1 + μ)) from W to W + addition, with μ the eigenvalues of W⁻¹ addition."""
        # log(1 + μ) ≤ μ for μ ≥ 0, and the root of a sum of squares is at most the sum of the numbers.
        return jnp.trace(solve(self.information, addition))

    def _propagate(self, start: Number | Matrix) -> Matrix:
        eye = jnp.eye(self.x.shape[0], dtype=self.x.dtype)
        # With π = L Lᵀ, (π⁻¹ + V)⁻¹ = L (I + Lᵀ V L)⁻¹ Lᵀ, which needs no inverse of π and stays positive definite.
        half = jnp.sqrt(start) * eye if jnp.ndim(start) == 0 else cholesky(jnp.asarray(start))
        half_propagated = half.T @ self.transition
        if self.spread is None:
            return half_propagated.T @ half_propagated
        return half_propagated.T @ solve(eye + half.T @ self.spread @ half, half_propagated)


def window_at(
    model: StateSpace,
    equation: Equation,
    x: Vector,
    length: Number,
    steps: int,
    u: Float[Array, "m"] | None = None,
) -> Window:
    """Window of the past that ends in x, in a fixed number of Runge–Kutta steps, as real time requires.

    Args:
        model: system with state x (n,) and output y (p,).
        equation: the Riccati equation.
        x: state (n,) at the end of the window.
        length: length of the window [s].
        steps: number of fourth-order steps.
        u: constant input (m,), zero by default.

    Returns:
        The window.

    Raises:
        ValueError: the length of x differs from the number of states of the model.

    Example:
        For x' = −x, y = x and λ = 3 the solution is P = 1, for any metric 20 s ago:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics import Equation
        >>> from covariant.metrics._window import window_at
        >>> from covariant.models import StateSpace
        >>> decay = StateSpace(lambda t, x, u: -x, lambda t, x, u: x)
        >>> window = window_at(decay, Equation(rate=3.0), jnp.array([0.5]), length=20.0, steps=200)
        >>> [round(float(window.metric(start)[0, 0]), 6) for start in (0.1, 10.0)]
        [1.0, 1.0]
    """
    check_state(model, x)
    flow = backward(model, equation, u, x.dtype)
    return rk4(flow, jnp.zeros((), x.dtype), no_past(equation, x), jnp.asarray(length, x.dtype), steps)


def backward(model: StateSpace, equation: Equation, u: Array | None, dtype):
    """Differential equation of a `Window` whose beginning moves back by s seconds."""
    input_held, t0 = model_input(model, u, dtype), jnp.zeros((), dtype)

    def flow(s, window: Window) -> Window:
        x, phi, _, v = window
        a, q, c = coefficients(model, equation, x, input_held)
        output = _times(c, phi)
        propagated = _times(a, phi)
        if q is None or v is None:
            # The beginning moves back in time, hence −f and −f_x; information can only accumulate.
            return Window(-model.f(t0, x, input_held), -propagated, _times(output.T, output), None)
        correlation = _times(v, c.T)
        drift = _times(a, v)
        # Φ' = −aΦ − V cᵀc Φ, W' = Φᵀcᵀc Φ and V' = Q − aV − V aᵀ − V cᵀc V, where s increases into the past.
        spread = q - drift - drift.T - _times(correlation, correlation.T)
        return Window(
            -model.f(t0, x, input_held), -propagated - _times(correlation, output), _times(output.T, output), spread
        )

    return flow


def _times(a: Array, b: Array) -> Array:
    """Product of two small matrices, written out; in a batch this is several times faster than a batched product."""
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def no_past(equation: Equation, x: Vector) -> Window:
    """The window of length 0 that ends in x (n,): Φ = I, W = V = 0."""
    zero = jnp.zeros((x.shape[0], x.shape[0]), x.dtype)
    eye = jnp.eye(x.shape[0], dtype=x.dtype)
    return Window(x, eye, zero, None if equation.process_cov is None else zero)
