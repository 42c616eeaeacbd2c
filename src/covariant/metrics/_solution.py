"""Computes the metric at a state, following the past for as long as needed."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._integrate import rk8
from covariant._linalg import whiten
from covariant._typing import Bounds, Code, Matrix, Number, Scalar, Vector
from covariant.metrics._equation import Equation, check_state
from covariant.metrics._window import Window, backward, no_past, window_at
from covariant.models import StateSpace
from covariant.signals import StepCode
from scalargraph.errors import InputError

MOST_STEPS = 1024
"""Number of integration steps after which the search for a sufficiently long past ends."""
SINGULAR = 1e-9
"""Reconstructibility below which a state counts as not reconstructible, in double precision."""
ON_BORDER = 1e-7
"""Fraction of the domain's width within which a state counts as lying on its border."""
FAR = 1e6
"""The past counts as escaped if a coordinate exceeds this many times one plus its final value."""


class Solution(NamedTuple):
    """Metric P at a state, and its accuracy.

    Attributes:
        metric: P (n, n); NaN if the result says that there is none.
        error_bound: bound on the affine-invariant distance to the solution with an infinite past; see
            `Window.error_bound`.
        horizon: length of the past that was used [s].
        reconstructibility: 0 … 1, smallest eigenvalue of W scaled to a unit diagonal; it does not depend on units.
        result: a `covariant.signals.StepCode` code. With `LEFT_DOMAIN` and `ESCAPED` the metric is the solution that
            equals `start` where the past begins.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import StepCode
        >>> from covariant.metrics import Equation, metric_at
        >>> from covariant.models import StateSpace
        >>> constant = StateSpace(lambda t, x, u: 0.0 * x, lambda t, x, u: x)
        >>> solution = metric_at(constant, Equation(rate=2.0), jnp.zeros(1))
        >>> StepCode(int(solution.result)).name, float(solution.error_bound) < 1e-7
        ('OK', True)
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
    """Solution of the Riccati equation at a state, with a past that is as long as needed.

    Works under `jit` and `vmap`.

    Use it to examine a metric at a few states, with an error bound and a result code. The amount of work depends on the
    state, so it is not for real time: use `RiccatiMetric` with a fixed past or `load_metric` there. If the past output
    does not determine the state, the result code says so.

    Args:
        model: system with state x (n,) and output y (p,).
        equation: the Riccati equation.
        x: state (n,).
        start: metric at the beginning of this past, a matrix (n, n) or a multiple of I.
        tolerance: largest change of P that the unknown earlier past may cause, as an affine-invariant distance (1e-8
            means eight digits in every direction, even in the weakest); by default half of the digits of the precision.
        domain: box in which the model is valid, its lower and upper corners (n,); the past is followed to its border at
            most. Unbounded by default.
        u: constant input (m,); zero by default. The time passed to f and h is zero.
        max_steps: number of integration steps after which the search ends.

    Returns:
        The metric, its error bound and a result code.

    Raises:
        ValueError: the length of x differs from the number of states of the model.

    Example:
        For x' = 0, y = x and λ = 2 the solution is P = 1/λ:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics import Equation, metric_at
        >>> from covariant.models import StateSpace
        >>> constant = StateSpace(lambda t, x, u: 0.0 * x, lambda t, x, u: x)
        >>> solution = metric_at(constant, Equation(rate=2.0), jnp.zeros(1))
        >>> round(float(solution.metric[0, 0]), 6)
        0.5
    """
    from covariant._adaptive import solve_until  # loads diffrax, a quarter of a second

    check_state(model, x)
    eps = float(jnp.finfo(x.dtype).eps)
    wanted = eps**0.5 if tolerance is None else tolerance
    # A thousandth of the tolerance keeps integration errors below the bound, but it must not be below rounding.
    rtol = max(1e-3 * wanted, 20 * eps)
    low, high = _box(domain, x)
    # The width of an unbounded side is replaced by 1: ∞/1 is infinitely far from the border, ∞/∞ would be NaN.
    width = jnp.where(jnp.isfinite(high - low), high - low, 1.0)
    far = FAR * (1 + jnp.abs(x))

    outside = jnp.any((x < low) | (x > high))

    def inside(y):
        """Distance to the border of the domain, as a fraction of its width; a point on the border counts as inside."""
        return jnp.min(jnp.minimum(y - low, high - y) / width) + ON_BORDER

    def escaped(y):
        return ~jnp.all(jnp.abs(y) < far)  # NaN counts as escaped

    def stop(window: Window):
        return outside | (window.error_bound(start) < wanted) | escaped(window.x)

    flow = backward(model, equation, u, x.dtype)
    begin = no_past(equation, x)
    border = None if domain is None else lambda window: inside(window.x)
    horizon, window = solve_until(flow, begin, stop, border, rtol=rtol, atol=1e-3 * rtol, max_steps=max_steps)
    metric: Array = window.metric(start)
    error_bound, index = window.error_bound(start), reconstructibility(window.information)
    finite = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(metric))
    # In single precision the threshold is larger, by the square root of the ratio of the rounding units.
    none = SINGULAR * (eps / float(jnp.finfo(jnp.float64).eps)) ** 0.5
    outcomes = (  # the first true condition determines the result
        (outside, StepCode.OUT_OF_DOMAIN),
        (~finite, StepCode.NOT_FINITE),
        # If the information is singular to rounding, its bound is only rounding noise and may have any sign.
        ((error_bound < wanted) & (index > none), StepCode.OK),
        (inside(window.x) < ON_BORDER if domain is not None else outside, StepCode.LEFT_DOMAIN),
        (escaped(window.x), StepCode.ESCAPED),
        (~(index > none), StepCode.NOT_RECONSTRUCTIBLE),
    )
    result = jnp.select([when for when, _ in outcomes], [int(code) for _, code in outcomes], int(StepCode.NOT_SETTLED))
    # Codes are ordered by severity; from this one on there is no metric.
    metric = jnp.where(result >= int(StepCode.NOT_RECONSTRUCTIBLE), jnp.nan, metric)
    return Solution(metric, error_bound, horizon, index, result.astype(jnp.int32))


def gramian(
    model: StateSpace, x: Vector, length: Number, u: Float[Array, "m"] | None = None, *, steps: int = 100
) -> Matrix:
    """Reconstructibility Gramian `∫ Φᵀ h_xᵀ h_x Φ dt` over the past of a state; equation (6).

    Args:
        model: system with state x (n,) and output y (p,).
        x: state (n,) at the end of the past.
        length: length of the past [s].
        u: constant input (m,), zero by default.
        steps: number of integration steps.

    Returns:
        Symmetric matrix (n, n).

    Example:
        A constant that is measured for 2 s:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics._solution import gramian
        >>> from covariant.models import StateSpace
        >>> constant = StateSpace(lambda t, x, u: 0.0 * x, lambda t, x, u: x)
        >>> round(float(gramian(constant, jnp.zeros(1), length=2.0)[0, 0]), 6)
        2.0
    """
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
    """Reconstructibility Gramians (6) over windows of the past of a state: the last 1/steps, 2/steps, … of it.

    Args:
        model: system with state x (n,) and output y (p,).
        x: state (n,) at the end of the past.
        length: length of the whole past [s].
        u: constant input (m,), zero by default.
        steps: number of windows.
        within: number of integration steps from one window to the next.

    Returns:
        Symmetric matrices (steps, n, n).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.metrics._solution import gramians
        >>> from covariant.models import StateSpace
        >>> constant = StateSpace(lambda t, x, u: 0.0 * x, lambda t, x, u: x)
        >>> [round(float(w), 6) for w in gramians(constant, jnp.zeros(1), length=2.0, steps=4)[:, 0, 0]]
        [0.5, 1.0, 1.5, 2.0]
    """
    check_state(model, x)
    unweighted = Equation(rate=jnp.zeros((), x.dtype))  # an array, since a Python number 0 is refused as a rate
    flow, zero = backward(model, unweighted, u, x.dtype), jnp.zeros((), x.dtype)

    def extend(window: Window, _):
        window = rk8(flow, zero, window, jnp.asarray(length, x.dtype) / steps, within)
        return window, window.information

    return jax.lax.scan(extend, no_past(unweighted, x), length=steps)[1]


def rate_from_gramian(
    model: StateSpace,
    points: Float[Array, "k n"],
    longest: float,
    u: Float[Array, "m"] | None = None,
    *,
    share: float = 0.5,
) -> float:
    """Rate λ = 1/τ [1/s] for equation (15), for which the metric weights the past needed to reconstruct a state.

    τ is the shortest window for which the least reconstructibility of the points is at least `share` of the best over
    all windows. A larger λ converges faster, but the metric is worse conditioned and passes more noise: (9) has the
    lower bound ε exp(−λτ).

    Use it only for systems whose past stays bounded.

    Args:
        model: system with state x (n,) and output y (p,).
        points: states (k, n), typical of the system's operation.
        longest: longest window [s].
        u: constant input (m,), zero by default.
        share: fraction of the best reconstructibility that suffices.

    Returns:
        The rate λ.

    Raises:
        ValueError: a point is not reconstructible from any of the windows, or the shortest window is the best. In the
            latter case the solution grows backward in time, as for a damped system, and a metric exists only for λ
            above twice its rate of growth.

    Example:
        A harmonic oscillator of 1 rad/s whose position is measured. Half a period determines its velocity well:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics import rate_from_gramian
        >>> from covariant.models import StateSpace
        >>> oscillator = StateSpace(lambda t, x, u: jnp.stack([x[1], -x[0]]), lambda t, x, u: x[:1])
        >>> rate = rate_from_gramian(oscillator, jnp.array([[1.0, 0.0]]), longest=6.0)
        >>> 0.3 < rate < 1.0
        True
    """
    indices = jax.jit(jax.vmap(lambda x: jax.vmap(reconstructibility)(gramians(model, x, longest, u))))(points)
    indices = np.nan_to_num(np.asarray(indices))  # (k, steps); a past that escapes counts as zero
    unobserved = indices.max(axis=1) <= SINGULAR
    if unobserved.any():
        point = ", ".join(f"{entry:.4g}" for entry in np.asarray(points)[int(unobserved.argmax())])
        raise InputError(f"({point}) is not reconstructible from any past up to {longest:g} s, so it has no rate")
    # One rate is chosen for all points, so each window is rated by the point that it determines worst.
    least = indices.min(axis=0)
    enough = int((least >= share * least.max()).argmax())
    if not enough:
        raise InputError(
            f"the first of {len(least)} windows up to {longest:g} s tells most: shorten the longest window, or, where "
            "the past grows, take a rate above twice its rate of growth"
        )
    # The window with index `enough`, counted from 0, has the length τ = longest (enough + 1)/steps.
    return len(least) / (longest * (enough + 1))


def reconstructibility(gramian: Matrix) -> Scalar:
    """Reconstructibility index: the smallest eigenvalue of a Gramian with its diagonal scaled to ones.

    Args:
        gramian: symmetric positive semidefinite matrix (n, n).

    Returns:
        Scalar from 0 (an unobserved direction) to 1; NaN for a Gramian that is not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.metrics._solution import reconstructibility
        >>> float(reconstructibility(jnp.array([[4.0, 0.0], [0.0, 0.0]])))
        0.0
    """
    diagonal: Array = jnp.diagonal(gramian)
    # A coordinate that is not observed keeps its zero row: it gives the eigenvalue 0 and no division by zero.
    scale = jnp.where(diagonal > 0, jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 0.0)
    # With a unit diagonal the index does not depend on the units of the coordinates.
    scaled = scale[:, None] * gramian * scale[None, :]
    finite = jnp.all(jnp.isfinite(scaled))
    least = jnp.linalg.eigvalsh(jnp.where(finite, scaled, 0.0))[0]
    # A Gramian has no negative eigenvalue, but rounding may make one of a singular matrix slightly negative.
    return jnp.where(finite, jnp.maximum(least, 0.0), jnp.nan)


def spd_distance(a: Matrix, b: Matrix) -> Scalar:
    """Affine-invariant distance `sqrt(Σ log² eig(a⁻¹ b))` of two symmetric positive definite matrices.

    It does not depend on coordinates, so it is small only when b is accurate in every direction. Source: Sanfelice &
    Praly 2015, equation (25); Bhatia 2007, Positive definite matrices.

    Args:
        a: matrix (n, n).
        b: matrix (n, n).

    Returns:
        The distance, a scalar; NaN if a or b is not positive definite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.metrics import spd_distance
        >>> round(float(spd_distance(jnp.eye(1), jnp.exp(2.0) * jnp.eye(1))), 9)
        2.0
    """
    whitened = whiten(a, b)
    finite = jnp.all(jnp.isfinite(whitened))
    ratios: Array = jnp.linalg.eigvalsh(jnp.where(finite, (whitened + whitened.T) / 2, 0.0))
    # A ratio ≤ 0 means that a or b is not positive definite; the distance is then NaN.
    return jnp.sqrt(jnp.sum(jnp.log(jnp.where(finite & (ratios > 0), ratios, jnp.nan)) ** 2))


class RiccatiMetric(eqx.Module):
    """The metric of the Riccati equation as a function `x (n,) -> (n, n)`, computed along the characteristic through x.

    Use it for `observers.Riccati` if a table over all states would be too large. Each call integrates over the past
    `length` in `steps` steps. If this past is too short, `start` still influences the result: compare with `metric_at`,
    which reports the length needed. For up to about three states, `load_metric` is cheaper.

    Attributes:
        model: the system.
        equation: the Riccati equation.
        length: length of the past that is used [s]. It is fixed, as is `steps`, so the function can be exported;
            `metric_at` finds the length that is needed.
        steps: number of Runge–Kutta steps along this past.
        start: metric at the beginning of this past, a matrix (n, n) or a multiple of I.
        u: constant input (m,), zero by default.

    Example:
        For x' = −x, y = x and λ = 3 the solution is P = 1:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics import Equation, RiccatiMetric
        >>> from covariant.models import StateSpace
        >>> decay = StateSpace(lambda t, x, u: -x, lambda t, x, u: x)
        >>> metric = RiccatiMetric(decay, Equation(rate=3.0), length=20.0, steps=200)
        >>> round(float(metric(jnp.array([0.5]))[0, 0]), 6)
        1.0
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
