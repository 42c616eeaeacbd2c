"""The metric at a state, from a past as long as needed."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._adaptive import solve_until
from covariant._integrate import rk8
from covariant._linalg import whiten
from covariant._typing import Bounds, Code, Matrix, Number, Scalar, Vector
from covariant.metrics._equation import Equation, check_state
from covariant.metrics._window import Window, backward, no_past, window_at
from covariant.models import StateSpace
from covariant.signals import Result

MOST_STEPS = 1024
"""Integration steps after which the past counts as too short in any case."""
SINGULAR = 1e-9
"""Reconstructibility below which a state counts as not reconstructible, in double precision."""
ON_BORDER = 1e-7
"""Fraction of a domain's width within which a state is on its border."""
FAR = 1e6
"""The past has escaped when a coordinate exceeds this many times one plus its final value."""


class Solution(NamedTuple):
    """P at a state, and how accurate it is.

    - `metric` (n, n): P; NaN where the result says that there is none.
    - `error_bound`: of the affine-invariant distance to the solution with an infinite past; see `Window.error_bound`.
    - `horizon`: length of the past that was used [s].
    - `reconstructibility`: 0 … 1, smallest eigenvalue of W with its diagonal scaled to one; independent of units.
    - `result`: a `covariant.signals.Result` code. With `LEFT_DOMAIN` and `ESCAPED` the metric is the solution that
      equals `start` where the past begins.
    """

    metric: Matrix
    error_bound: Scalar
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
    domain: Bounds | None = None,
    u: Float[Array, "m"] | None = None,
    max_steps: int = MOST_STEPS,
) -> Solution:
    """Solve the equation at x (n,), with as long a past as needed.

    - `start`: the metric before the past that is used, as a matrix or a multiple of I.
    - `tolerance`: largest change of P by the unknown earlier past, as an affine-invariant distance (1e-8 means eight
      digits in every direction, the weakest too); by default half of the digits of the precision.
    - `domain`: box in which the model is valid; the past is followed no further than its border.
    - `u`: constant input (m,); zero by default. The time given to f and h is zero.
    - `max_steps`: integration steps after which the search ends.

    Works under `jit` and `vmap`. Raises `ValueError` when the length of x is not the number of states of the model.
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
        """Distance to the border of the domain, as a fraction of its width; on the border it counts as inside."""
        return jnp.min(jnp.minimum(y - low, high - y) / width) + ON_BORDER

    def gone(y):
        return ~jnp.all(jnp.abs(y) < far)  # NaN counts as escaped

    def stop(window: Window):
        return outside | (window.error_bound(start) < wanted) | gone(window.x)

    flow = backward(model, equation, u, x.dtype)
    begin = no_past(equation, x)
    border = None if domain is None else lambda window: inside(window.x)
    horizon, window = solve_until(flow, begin, stop, border, rtol=rtol, atol=1e-3 * rtol, max_steps=max_steps)
    metric: Array = window.metric(start)
    error_bound, index = window.error_bound(start), reconstructibility(window.information)
    finite = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(metric))
    none = SINGULAR * (eps / float(jnp.finfo(jnp.float64).eps)) ** 0.5
    outcomes = (  # the first true condition determines the result
        (outside, Result.OUT_OF_DOMAIN),
        (~finite, Result.NOT_FINITE),
        # Where the information is singular to rounding, its bound is rounding noise and may have any sign.
        ((error_bound < wanted) & (index > none), Result.OK),
        (inside(window.x) < ON_BORDER if domain is not None else outside, Result.LEFT_DOMAIN),
        (gone(window.x), Result.ESCAPED),
        (~(index > none), Result.NOT_RECONSTRUCTIBLE),
    )
    result = jnp.select([when for when, _ in outcomes], [int(code) for _, code in outcomes], int(Result.NOT_SETTLED))
    metric = jnp.where(result >= int(Result.NOT_RECONSTRUCTIBLE), jnp.nan, metric)
    return Solution(metric, error_bound, horizon, index, result.astype(jnp.int32))


def gramian(
    model: StateSpace, x: Vector, length: Number, u: Float[Array, "m"] | None = None, *, steps: int = 100
) -> Matrix:
    """Reconstructibility Gramian `∫ Φᵀ h_xᵀ h_x Φ dt` over the last `length` seconds before x, equation (6)."""
    return gramians(model, x, length, u, steps=1, within=steps)[-1]


def gramians(
    model: StateSpace,
    x: Vector,
    length: Number,
    u: Float[Array, "m"] | None = None,
    *,
    steps: int = 64,
    within: int = 2,
) -> Float[Array, "steps n n"]:
    """Gramians (6) over the last 1/steps, 2/steps, … of `length` [s] before x (n,)."""
    check_state(model, x)
    unweighted = Equation(rate=jnp.zeros((), x.dtype))  # as an array, since the number 0 is refused as a rate
    flow, zero = backward(model, unweighted, u, x.dtype), jnp.zeros((), x.dtype)

    def further(window: Window, _):
        window = rk8(flow, zero, window, jnp.asarray(length, x.dtype) / steps, within)
        return window, window.information

    return jax.lax.scan(further, no_past(unweighted, x), length=steps)[1]


def rate_from_gramian(
    model: StateSpace,
    points: Float[Array, "k n"],
    longest: float,
    u: Float[Array, "m"] | None = None,
    *,
    share: float = 0.5,
) -> float:
    """A rate λ = 1/τ [1/s] for equation (15), such that the metric weights about as much past as reconstructs a state.

    τ is the shortest window for which the least reconstructibility of the `points` (k, n) is at least `share` of the
    best over all windows up to `longest` [s]. A larger λ converges faster, but the metric is worse conditioned and
    passes more noise: (9) has the lower bound ε exp(−λτ).

    This is for systems whose past stays bounded. Raises `ValueError` where a point is not reconstructible from any of
    the windows, and where the shortest window is the best. In the latter case the solution grows backwards in time, as
    that of a damped system does, and a metric exists only for λ above twice its rate of growth.
    """
    told = jax.jit(jax.vmap(lambda x: jax.vmap(reconstructibility)(gramians(model, x, longest, u))))(points)
    told = np.nan_to_num(np.asarray(told))  # (k, steps); a past that escapes counts as zero
    unobserved = told.max(axis=1) <= SINGULAR
    if unobserved.any():
        point = ", ".join(f"{entry:.4g}" for entry in np.asarray(points)[int(unobserved.argmax())])
        raise ValueError(f"({point}) is not reconstructible from any past up to {longest:g} s, so it has no rate")
    least = told.min(axis=0)
    enough = int((least >= share * least.max()).argmax())
    if not enough:
        raise ValueError(
            f"the first of {len(least)} windows up to {longest:g} s tells most: shorten the longest window, or, where "
            "the past grows, take a rate above twice its rate of growth"
        )
    return len(least) / (longest * (enough + 1))


def reconstructibility(gramian: Matrix) -> Scalar:
    """Smallest eigenvalue of a Gramian (n, n) with its diagonal scaled to ones: 0 (an unobserved direction) … 1."""
    diagonal: Array = jnp.diagonal(gramian)
    scale = jnp.where(diagonal > 0, jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 0.0)
    scaled = scale[:, None] * gramian * scale[None, :]
    finite = jnp.all(jnp.isfinite(scaled))
    least = jnp.linalg.eigvalsh(jnp.where(finite, scaled, 0.0))[0]
    return jnp.where(finite, jnp.maximum(least, 0.0), jnp.nan)


def spd_distance(a: Matrix, b: Matrix) -> Scalar:
    """Affine-invariant distance `sqrt(Σ log² eig(a⁻¹ b))` of two symmetric positive definite matrices (n, n).

    It does not depend on coordinates, so it is small only when b is accurate in every direction. NaN where a or b is
    not positive definite. Source: Sanfelice & Praly 2015, equation (25); Bhatia 2007, Positive definite matrices.
    """
    whitened = whiten(a, b)
    finite = jnp.all(jnp.isfinite(whitened))
    ratios: Array = jnp.linalg.eigvalsh(jnp.where(finite, (whitened + whitened.T) / 2, 0.0))
    return jnp.sqrt(jnp.sum(jnp.log(jnp.where(finite & (ratios > 0), ratios, jnp.nan)) ** 2))


class RiccatiMetric(eqx.Module):
    """The metric of the Riccati equation as a function `x (n,) -> (n, n)`, computed along the characteristic through x.

    - `length`: of the past that is used [s]; `steps`: Runge–Kutta steps along it. Both are fixed, so the function can
      be exported; `metric_at` finds how long is long enough.
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


def _box(domain: Bounds | None, x: Vector):
    if domain is None:
        return jnp.full_like(x, -jnp.inf), jnp.full_like(x, jnp.inf)
    low, high = (jnp.asarray(bound, x.dtype) for bound in domain)
    return low, high
