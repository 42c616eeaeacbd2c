"""The metric at a state, with a past as long as it needs."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._integrate import rk8, solve_until
from covariant._linalg import whiten
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.models import StateSpace
from covariant.riccati._equation import Equation, check_state
from covariant.riccati._window import Window, backward, no_past, window_at
from covariant.signals import Result

MOST_STEPS = 1024
"""Integration steps after which a window counts as never long enough."""
SINGULAR = 1e-9
"""Reconstructibility below which a state counts as not reconstructible, in double precision."""
ON_BORDER = 1e-7
"""Share of a domain's width within which a state is on its border."""
FAR = 1e6
"""A past has escaped when a coordinate exceeds this many times one plus its value at the end."""

Box = tuple[Float[Array, "n"], Float[Array, "n"]]
"""Lower and upper bounds of a domain."""


class Solution(NamedTuple):
    """P at a state, and how far to trust it.

    - `metric` (n, n): P; NaN where the result says that there is none.
    - `doubt`: bound on the affine-invariant distance to the solution with an endless past; see `Window.doubt`.
    - `horizon`: length of the past that was used [s].
    - `reconstructibility`: 0 … 1, smallest eigenvalue of W after scaling its diagonal to one; no unit changes it.
    - `result`: a `covariant.signals.Result` code. With `LEFT_DOMAIN` and `ESCAPED` the metric is the solution that has
      `start` where the past begins.
    """

    metric: Matrix
    doubt: Scalar
    horizon: Scalar
    reconstructibility: Scalar
    result: Code


def metric_at(
    model: StateSpace,
    equation: Equation,
    x: Vector,
    *,
    start: Number | Matrix = 1.0,
    tolerance: float | None = None,
    domain: Box | None = None,
    u: Float[Array, "m"] | None = None,
    max_steps: int = MOST_STEPS,
) -> Solution:
    """Solve the equation at x (n,), looking back as far as needed.

    - `start`: the metric before the past that is looked at, as a matrix or a multiple of I.
    - `tolerance`: how much the unknown past may change P, as an affine-invariant distance (1e-8 means eight digits in
      every direction, the weakest too); by default half of the digits.
    - `domain`: box where the model holds; the past is followed no further than its border.
    - `u`: constant input (m,); zero by default. The time that f and h are given is zero.

    Works under `jit` and `vmap`. Raises `ValueError` when x has not as many entries as the model has states.
    """
    check_state(model, x)
    eps = float(jnp.finfo(x.dtype).eps)
    wanted = eps**0.5 if tolerance is None else tolerance
    rtol = max(1e-3 * wanted, 20 * eps)
    low, high = _box(domain, x)
    width = jnp.where(jnp.isfinite(high - low), high - low, 1.0)
    far = FAR * (1 + jnp.abs(x))

    outside = jnp.any((x < low) | (x > high))

    def inside(y):
        """Share of the domain's width that is left to its border; a start on the border counts as inside."""
        return jnp.min(jnp.minimum(y - low, high - y) / width) + ON_BORDER

    def gone(y):
        return ~jnp.all(jnp.abs(y) < far)  # NaN has gone too

    def stop(window: Window):
        return outside | (window.doubt(start) < wanted) | gone(window.x)

    flow = backward(model, equation, u, x.dtype)
    begin = no_past(equation, x)
    border = None if domain is None else lambda window: inside(window.x)
    horizon, window = solve_until(flow, begin, stop, border, rtol=rtol, atol=1e-3 * rtol, max_steps=max_steps)
    metric: Array = window.metric(start)
    doubt, index = window.doubt(start), reconstructibility(window.information)
    finite = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(metric))
    none = SINGULAR * (eps / float(jnp.finfo(jnp.float64).eps)) ** 0.5
    outcomes = (  # the first that is true holds
        (outside, Result.OUT_OF_DOMAIN),
        (~finite, Result.NOT_FINITE),
        (doubt < wanted, Result.OK),
        (inside(window.x) < ON_BORDER if domain is not None else outside, Result.LEFT_DOMAIN),
        (gone(window.x), Result.ESCAPED),
        (~(index > none), Result.NOT_RECONSTRUCTIBLE),
    )
    result = jnp.select([when for when, _ in outcomes], [int(code) for _, code in outcomes], int(Result.NOT_SETTLED))
    metric = jnp.where(result >= int(Result.NOT_RECONSTRUCTIBLE), jnp.nan, metric)
    return Solution(metric, doubt, horizon, index, result.astype(jnp.int32))


def gramian(
    model: StateSpace, x: Vector, length: Number, u: Float[Array, "m"] | None = None, *, steps: int = 100
) -> Matrix:
    """Reconstructibility Gramian `∫ Φᵀ h_xᵀ h_x Φ dt` over the last `length` seconds before x, equation (6)."""
    flow = backward(model, Equation(rate=jnp.zeros((), x.dtype)), u, x.dtype)
    window = rk8(flow, jnp.zeros((), x.dtype), no_past(Equation(1.0), x), jnp.asarray(length, x.dtype), steps)
    return window.information


def reconstructibility(gramian: Matrix) -> Scalar:
    """Smallest eigenvalue of a Gramian (n, n) scaled to a diagonal of ones: 0 (a direction is not seen) … 1."""
    diagonal: Array = jnp.diagonal(gramian)
    scale = jnp.where(diagonal > 0, jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 0.0)
    scaled = scale[:, None] * gramian * scale[None, :]
    finite = jnp.all(jnp.isfinite(scaled))
    least = jnp.linalg.eigvalsh(jnp.where(finite, scaled, 0.0))[0]
    return jnp.where(finite, jnp.maximum(least, 0.0), jnp.nan)


def spd_distance(a: Matrix, b: Matrix) -> Scalar:
    """Affine-invariant distance `sqrt(Σ log² eig(a⁻¹ b))` of two symmetric positive definite matrices (n, n).

    It does not change with coordinates, so it is small only when b is right in every direction. NaN where a or b is not
    positive definite. Source: Sanfelice & Praly 2015, equation (25); Bhatia 2007, Positive definite matrices.
    """
    whitened = whiten(a, b)
    finite = jnp.all(jnp.isfinite(whitened))
    ratios: Array = jnp.linalg.eigvalsh(jnp.where(finite, (whitened + whitened.T) / 2, 0.0))
    return jnp.sqrt(jnp.sum(jnp.log(jnp.where(finite & (ratios > 0), ratios, jnp.nan)) ** 2))


class Metric(eqx.Module):
    """P computed where it is needed, along the characteristic through that state: a function `x (n,) -> (n, n)`.

    - `length`: of the past that is looked at [s]; `steps`: Runge–Kutta steps along it. Both are fixed, so the function
      can be exported; `metric_at` tells how long is long enough.
    - `start`, `u`: as for `metric_at`.
    """

    model: StateSpace
    equation: Equation
    length: Number
    steps: int = eqx.field(static=True)
    start: Number | Matrix = 1.0
    u: Float[Array, "m"] | None = None

    def __call__(self, x: Vector) -> Matrix:
        window = window_at(self.model, self.equation, x, self.length, self.steps, self.u)
        return window.metric(self.start)


def _box(domain: Box | None, x: Vector):
    if domain is None:
        return jnp.full_like(x, -jnp.inf), jnp.full_like(x, jnp.inf)
    low, high = (jnp.asarray(bound, x.dtype) for bound in domain)
    return low, high
