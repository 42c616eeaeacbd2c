"""Defines the Riccati equation of a contraction metric, and computes its two sides."""

import inspect
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._linalg import half_solve
from covariant._typing import Matrix, MatrixField, Number, Scalar, StateField, Vector
from covariant.models import StateSpace
from scalargraph import along, jacobian
from scalargraph.errors import InputError


class Equation(eqx.Module):
    """Riccati equation `L_f P = dhᵀ R⁻¹ dh − λ P − P Q P` for the metric P.

    It is equation (8) of the paper if only Q is set, and (15) if only λ is set.

    A rate λ gives a metric that contracts at a known rate; Q gives the metric of a Kalman–Bucy filter with this noise.
    Use it in `metric_at` and `RiccatiMetric`. Q and R are spectral densities: for a sampled sensor, R is the variance
    of one sample divided by the sampling rate, as `observers.StateNoise` computes it.

    Attributes:
        rate: λ [1/s], 0 by default; the observer with gain ¼ contracts the distance in P at the rate λ/2.
        process_cov: Q, a symmetric positive matrix (n, n), or a field `x -> (n, n)`; none by default. Under a change of
            coordinates z(x) it becomes `z_x Q z_xᵀ`. In a filter it is the spectral density of the process noise.
        measurement_cov: R (p, p), by default the identity. In a filter it is the spectral density of the measurement
            noise.

    Raises:
        ValueError: there is neither λ nor Q, or λ is negative.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.metrics import Equation
        >>> Equation(rate=2.0, process_cov=jnp.eye(1)).noise(jnp.zeros(1)).tolist()
        [[1.0]]
    """

    rate: Number = 0.0
    process_cov: Matrix | MatrixField | None = None
    measurement_cov: Float[Array, "p p"] | None = None

    def __check_init__(self):
        # Only Python numbers are checked, since the value of an array is unknown in a compiled function.
        if isinstance(self.rate, float | int):
            if not 0 <= self.rate < float("inf"):
                raise InputError(f"rate must be a number ≥ 0; got {self.rate}")
            # Without λ and Q the past is never forgotten, and W grows without bound.
            if self.rate == 0 and self.process_cov is None:
                raise InputError("an equation needs a rate λ > 0, a process_cov Q, or both; it has neither")

    def noise(self, x: Vector) -> Matrix | None:
        """Q (n, n) at the state x (n,), or None if the equation has no Q."""
        q = self.process_cov(x) if callable(self.process_cov) else self.process_cov
        return None if q is None else jnp.asarray(q, x.dtype)


def with_time(metric: StateField) -> Callable[[Scalar, Vector], Matrix]:
    """The metric as a function `(t, x) -> (n, n)`, from a function of both or of the state alone."""
    arguments = inspect.signature(metric).parameters.values()
    required = [each for each in arguments if each.default is each.empty and each.kind <= each.POSITIONAL_OR_KEYWORD]
    return metric if len(required) > 1 else lambda t, x: metric(x)


def lie_derivative(model: StateSpace, metric: StateField, x: Vector, u: Float[Array, "m"] | None = None) -> Matrix:
    """Lie derivative `L_f P = Ṗ + P f_x + f_xᵀ P` of a metric; G-8 of the paper.

    Args:
        model: system with state x (n,) and output y (p,).
        metric: P as a function `x -> (n, n)`, or `(t, x) -> (n, n)`, which is taken at t = 0.
        x: state (n,).
        u: constant input (m,), zero by default.

    Returns:
        Symmetric matrix (n, n).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.metrics import lie_derivative
        >>> from covariant.models import StateSpace
        >>> decay = StateSpace(lambda t, x, u: -x, lambda t, x, u: x)
        >>> lie_derivative(decay, lambda x: jnp.eye(1), jnp.array([0.5])).tolist()
        [[-2.0]]
    """
    input_held, t0 = model_input(model, u, x.dtype), jnp.zeros((), x.dtype)
    p, change = along(with_time(metric), (t0, x), (jnp.ones_like(t0), model.f(t0, x, input_held)))
    a = jacobian(lambda y: model.f(t0, y, input_held), x)
    return change + p @ a + a.T @ p


def coefficients(model: StateSpace, equation: Equation, x: Vector, u: Array):
    """Coefficients of the Riccati equation at a state."""
    a, c = model.jacobians(jnp.zeros((), x.dtype), x, u)
    eye = jnp.eye(x.shape[0], dtype=x.dtype)
    if equation.measurement_cov is not None:
        # With R = L Lᵀ, (L⁻¹c)ᵀ(L⁻¹c) = cᵀR⁻¹c, so R⁻¹ need not be formed.
        c = half_solve(jnp.asarray(equation.measurement_cov, x.dtype), c)
    # P(f_x + λ/2) + (f_x + λ/2)ᵀ P = P f_x + f_xᵀ P + λ P.
    shifted = a + jnp.asarray(equation.rate, x.dtype) / 2 * eye
    return shifted, equation.noise(x), c


def model_input(model: StateSpace, u: Array | None, dtype) -> Array:
    """The input u (m,), or zero for None, in the precision `dtype`."""
    return jnp.zeros(model.inputs, dtype) if u is None else jnp.asarray(u, dtype)


def check_state(model: StateSpace, x: Array) -> None:
    """Check the shape of a state."""
    n = len(model.coordinates)
    if x.ndim != 1 or (n and x.shape[0] != n):
        raise InputError(f"x must be a state ({n or 'n'},); it has shape {x.shape}")
