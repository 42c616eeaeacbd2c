"""Bounds interval, gain and rate for which the sampled error of `LagrangianMetric` provably decreases.

Let ξ be the error of the position, ζ of the velocity, `w = ζ − σξ`, `K = R(·, v)v − ∇S` with its spectrum in [k₋, k₊],
F = ∇_v of the friction in [f₋, f₊], f₊ ≤ 0, and 0 ≤ ρ < σ. Along the model `ξ' = w + σξ` and
`w' = −(K + σ² − σF)ξ − (σ − F)w`, so that `V = m|ξ|² + |w|²` decreases as e^(−2ρt) if

    m' = −2(σ + ρ)m − max |m − σ² − k + σf|² / (2(σ − ρ − f))        over k in [k₋, k₊] and f in [f₋, f₊]

(complete the square in w). A sample changes ξ to (1 − θ)ξ and keeps w, so that `m₀|ξ|² + |w|²` decreases by e^(−2ρh) in
each step for all θ with `(1 − θ)² ≤ m_h/m₀`: an interval [θ_min, 2 − θ_min], for errors of any size.

The maximum is at a corner, since the quotient is convex in (k, f). At each corner m obeys a Riccati equation with
constant coefficients, `m' = −((m + b)² + D)/2g`, with a solution in closed form. For F = 0, k₋ = k₊ = k and ρ = 0 the
largest h is `(2/√k) atan(√k/σ)`, exactly where the step with θ = 1 becomes unstable, so the bound is tight. With
friction it is not tight: the range of f is a further uncertainty, and may increase θ_min.

On a curved space the correction gives `ξ⁺ = J(θ)`, `w⁺ = Π(w + ∫₀^θ R(γ', J)(v̂ + σsγ') ds)`, where J is the Jacobi
field along the geodesic γ from q̂ to y with J(0) = ξ and J(1) = 0: w changes, and these limits are for one coordinate or
a flat metric.

Source: an addition. Simpson-Porco & Bullo 2014, Contraction theory on Riemannian manifolds, Systems & Control Letters
65, for lengths of curves.
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

from covariant._domains import INTERVAL, Finite, NotNegative, Positive, check_numbers
from scalargraph.errors import InputError

Damping = Annotated[
    tuple[float, float],
    INTERVAL._replace(
        words="be two finite numbers ≤ 0, the lower one first", contains=lambda a: INTERVAL.contains(a) and a[1] <= 0
    ),
]


class PartLimits(NamedTuple):
    """Parts θ of an error that a sample may remove, with the metric of the proof.

    Attributes:
        least: The least θ.
        most: The largest θ, `2 − least`; `LagrangianMetric` itself stays below 1.
        before: Weight m₀ of |ξ|² after a correction [1/s²].
        after: Weight m_h of |ξ|² before the next correction [1/s²].

    Example:
        >>> from covariant.certificates import part_limits
        >>> limits = part_limits(0.1, sigma=2.0, k_minus=-1.0, k_plus=1.0)
        >>> abs((1 - limits.least) ** 2 - limits.after / limits.before) < 1e-12
        True
    """

    least: float
    most: float
    before: float
    after: float


class _Corner(NamedTuple):
    """A corner of the ranges of k and f, at which `m' = −((m + b)² + D)/2g`."""

    a: float
    g: float
    b: float
    d: float

    def square(self, m: float) -> float:
        """The squared term in the maximum."""
        return (m - self.a) ** 2 / self.g

    def time(self, high: float, low: float) -> float:
        """Time [s] in which m decreases from `high`, which may be infinite, to `low`."""
        x0, x1, root = high + self.b, low + self.b, math.sqrt(abs(self.d))
        # (x0 − x1)/(D + x0 x1), the tangent of the difference of two angles over √|D|
        above, below = (1.0, x1) if math.isinf(x0) else (x0 - x1, self.d + x0 * x1)
        if self.d > 0:
            return 2 * self.g / root * math.atan2(root * above, below)
        if root * above >= below:  # at the root of the square itself, where m takes forever
            return math.inf
        return 2 * self.g / root * math.atanh(root * above / below) if root > 0 else 2 * self.g * above / below

    def after(self, high: float, time: float) -> float:
        """Value of m some time after it was `high`."""
        x, angle = high + self.b, math.sqrt(abs(self.d)) * time / (2 * self.g)
        if self.d > 0:
            c, s = math.cos(angle), math.sin(angle) / math.sqrt(self.d)
        elif self.d < 0:
            c, s = math.cosh(angle), math.sinh(angle) / math.sqrt(-self.d)
        else:
            c, s = 1.0, time / (2 * self.g)
        return (x * c - self.d * s) / (x * s + c) - self.b


class _Weight(NamedTuple):
    """The weight m as a function of time: the corner that is decisive below each of some values, largest first."""

    tops: tuple[float, ...]
    corners: tuple[_Corner, ...]

    def longest(self) -> float:
        """Time in which m decreases from infinity to 0."""
        ends = (*self.tops[1:], 0.0)
        return sum(c.time(top, end) for c, top, end in zip(self.corners, self.tops, ends, strict=True))

    def after(self, m: float, time: float) -> float:
        """Value of m some time after it was `m`; 0 if it has decreased to 0 before."""
        for corner, end in zip(self.corners, (*self.tops[1:], 0.0), strict=True):
            if m > end:
                spent = corner.time(m, end)
                if spent > time:
                    return max(corner.after(m, time), 0.0)
                m, time = end, time - spent
        return 0.0


def weight_of(sigma: float, rate: float, k: Sequence[float], f: Sequence[float] = (0.0, 0.0)) -> _Weight:
    """The weight m of |ξ|² between samples."""
    corners = []
    for stiffness in set(k):
        for slope in set(f):
            a, g = sigma**2 + stiffness - sigma * slope, sigma - rate - slope
            b = 2 * g * (sigma + rate) - a
            corners.append(_Corner(a, g, b, a * a - b * b))
    crossings = {math.inf}
    for i, one in enumerate(corners):
        for two in corners[:i]:
            for sign in (1.0, -1.0):  # |m − a₁|/√g₁ = |m − a₂|/√g₂
                p, q = math.sqrt(two.g), sign * math.sqrt(one.g)
                m = (one.a * p - two.a * q) / (p - q) if p != q else 0.0
                crossings |= {m} if m > 0 else set()
    tops = sorted(crossings, reverse=True)
    # A single corner is decisive between two crossings, so any point of the interval determines it.
    inner = [min((top + end) / 2, 2 * end + 1) for top, end in zip(tops, (*tops[1:], 0.0), strict=True)]
    return _Weight(tuple(tops), tuple(max(corners, key=lambda c: c.square(m)) for m in inner))


@check_numbers
def longest_interval(
    sigma: Positive,
    k_minus: Finite,
    k_plus: Finite,
    rate: NotNegative = 0.0,
    friction: Damping = (0.0, 0.0),
) -> float:
    """Compute the sampling interval below which some gain α makes the error decrease at a rate, as all larger α do.

    Args:
        sigma: Ratio σ = β/α of the gains [1/s].
        k_minus: Least eigenvalue of `K = R(·, v)v − ∇S` [1/s²].
        k_plus: Largest eigenvalue of K [1/s²].
        rate: Rate ρ [1/s], 0 ≤ ρ < σ; 0 by default, for errors that do not grow.
        friction: Bounds [1/s] of the derivative of the friction by the velocity, both ≤ 0; no friction by default. For
            n > 1 this derivative must be the same in all directions.

    Returns:
        The interval [s], infinite if there is no limit. For k₋ = k₊ = k, ρ = 0 and no friction it is
        `(2/√k) atan(√k/σ)`, 2/σ at k = 0, and `(2/√−k) artanh(min(σ, √−k)/max(σ, √−k))` for k < 0.

    Raises:
        ValueError: A number is not finite, bounds are in the wrong order, or ρ is not in [0, σ).

    Example:
        A free body, for which K vanishes:

        >>> from covariant.certificates import longest_interval
        >>> longest_interval(sigma=4.0, k_minus=0.0, k_plus=0.0)
        0.5
    """
    _check_order("longest_interval", sigma, k_minus, k_plus, rate)
    return weight_of(sigma, rate, (k_minus, k_plus), friction).longest()


@check_numbers
def part_limits(
    h: Positive,
    sigma: Positive,
    k_minus: Finite,
    k_plus: Finite,
    rate: NotNegative = 0.0,
    friction: Damping = (0.0, 0.0),
) -> PartLimits:
    """Compute the parts θ of an error that samples may remove for it to decrease at a rate, for n = 1 or flat metrics.

    The length `√(m₀|ξ|² + |w|²)` between two estimates, or an estimate and the truth, then decreases by e^(−ρh) from
    sample to sample, however large it is. The assumptions are: n = 1 or the metric is flat; measurements are unwrapped
    (angles are numbers, not circles), without noise and at most h apart; K is symmetric (forces without friction have a
    potential at each time); and its spectrum is within the bounds wherever the errors are.

    Args:
        h: Time between two measurements [s].
        sigma: Ratio σ = β/α of the gains [1/s].
        k_minus: Least eigenvalue of `K = R(·, v)v − ∇S` [1/s²]; −9.81 for a pendulum of 1 m.
        k_plus: Largest eigenvalue of K [1/s²].
        rate: Rate ρ [1/s], 0 ≤ ρ < σ; 0 by default.
        friction: As for `longest_interval`.

    Returns:
        The least and the largest θ, and the weights m₀ and m_h of the metric.

    Raises:
        ValueError: As for `longest_interval`, and if h is not below it.

    Example:
        A free body, for which θ_min = 2σh/(2 + σh) and m₀ m_h = σ⁴:

        >>> from covariant.certificates import part_limits
        >>> limits = part_limits(0.1, sigma=4.0, k_minus=0.0, k_plus=0.0)
        >>> round(limits.before * limits.after, 4), round(limits.least, 6)
        (256.0, 0.333333)
    """
    _check_order("part_limits", sigma, k_minus, k_plus, rate)
    weight = weight_of(sigma, rate, (k_minus, k_plus), friction)
    if h >= weight.longest():
        raise InputError(
            f"part_limits: h must be below {weight.longest():.4g} s at this σ and rate; got {h} s. Sample faster, or "
            "choose another sigma or a smaller rate"
        )
    before, after = _best(weight, h, sigma)
    least = 1 - math.sqrt(after / before)
    return PartLimits(least, 2 - least, before, after)


def _best(weight: _Weight, h: float, sigma: float) -> tuple[float, float]:
    """Weights m₀ and m_h with the largest m_h/m₀, which has a single maximum in log m₀."""
    from scipy.optimize import minimize_scalar

    scale = math.log(sigma**2 + max(abs(corner.a) for corner in weight.corners))

    def loss(x: float) -> float:
        m0 = math.exp(x)
        m = weight.after(m0, h)
        # If m decreases to 0 within h, nothing is proved; a slope then leads the search to larger m₀.
        return math.log(m0 / m) if m > 0 else 1e3 - x

    x = minimize_scalar(loss, bounds=(scale - 25, scale + 25), method="bounded", options={"xatol": 1e-10}).x
    return math.exp(x), weight.after(math.exp(x), h)


def _check_order(whose: str, sigma: float, k_minus: float, k_plus: float, rate: float) -> None:
    """Raise `InputError` in the name of a function if its numbers contradict each other."""
    if not (rate < sigma and k_minus <= k_plus):
        raise InputError(
            f"{whose}: needs rate < sigma and k_minus ≤ k_plus; got rate = {rate}, sigma = {sigma}, "
            f"k_minus = {k_minus}, k_plus = {k_plus}"
        )
