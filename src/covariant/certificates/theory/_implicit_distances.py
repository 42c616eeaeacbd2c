"""Bounds how distances between the estimates of `LagrangianMetric` and the truth decrease on a curved space.

A correction on a curved space enlarges lengths of curves. The distance of an estimate
x̂ = (q̂, v̂) from the truth x = (q, v) need not grow with them. In the metric `m|ξ|² + |w|²`, w = ζ − σξ, it is

    D² = min over the curves c from q̂ to q of  m L(c)² + |P_c v̂ − v|²,

where P_c transports by `∇v = σc'`. The states project to positions by a Riemannian submersion, transport is an isometry
of velocities, and a correction moves the estimate along the horizontal lift of the geodesic γ to the measurement y = q.

Let c be a curve that attains D, and contract it towards q along geodesics by the part θ. It becomes a curve from γ(θ)
to q of at most the length j L, where j = sin((1 − θ)x)/sin x, x = √κ R (Rauch; 1 − θ for κ ≤ 0), R = D/√m ≥ L.
Transport
of v̂ along both sides of the strip between the curves differs by at most the integral of |R(a, b)v| over the strip,
where |v| is at most V + σ(j + θ)R. The area of the strip is at most ϑ times the area between a plane curve of length L
and its chord (unroll the cone of geodesics over c), with `ϑ = 2(cos((1 − θ)x) − cos x)/(x sin x)`, or θ(2 − θ) for
κ ≤ 0; the plane area is at most that of the half-disc, L²/2π (Dido). With weights m₀ after and m_h before the
correction, therefore,

    D⁺² ≤ m₀j²L² + (|P_c v̂ − v| + ϑΛL²/2π)²,   Λ = r(V + σ(j + θ)R),

which is at most `D² = m_h L² + |P_c v̂ − v|²` if

    j² m₀/m_h + λϑ/π ≤ 1,   λ = ΛD/m_h,   λϑ ≤ 2π.

For n = 1 there is no curvature: λ = 0, and only (1 − θ)² ≤ m₀/m_h is required, at any distance. On a curved space any θ
up to 1 is allowed while λ < π. This limit is close to the true one: for λ > 2π a loop at constant curvature turns v̂
towards v at lower cost than a change of v̂, and there are pairs of states whose distance grows with every θ.

Between samples the model shrinks lengths and thus distances, as in `part_limits`; on the relevant curves the speed is
at most `V + √(1 + σ²/m_h) D`, and positions are within R of the true one.

Source: an addition. Sanfelice & Praly 2015, section I, for distances instead of lengths, and for one output; O'Neill
1966, The fundamental equations of a submersion, Michigan Math. J. 13, for the curvature that limits several outputs.
"""

import math
from typing import Annotated, NamedTuple

from covariant._domains import ABOVE_ZERO, Interval, NotNegative, Positive, Share, check_numbers
from covariant.certificates.theory._implicit_limits import weight_of


class DistanceBounds(NamedTuple):
    """Bounds of motion, errors, stiffness and curvature, with lengths and speeds in the metric of the space.

    Attributes:
        speed: Largest true speed V, `|v| ≤ V`.
        error: Largest distance of the first estimated position from the measurement, before it is corrected.
        velocity_error: Largest `|Πv̂ − v|` at that time; Π transports v̂ along that geodesic.
        stiffness: Least and largest eigenvalue of −∇S [1/s²], the covariant Hessian of the potential energy.
        curvature: Least and largest sectional curvature.
        riemann: Bound r with `|R(a, b)c| ≤ r|a ∧ b||c|`; None (default) for n ≤ 2, where it is the largest |curvature|.
        injectivity: Distance up to which each position has a single shortest geodesic from a measurement; infinite on
            the plane if no curvature is positive.

    Example:
        >>> from covariant.certificates.theory import DistanceBounds
        >>> DistanceBounds(1.0, 0.5, 1.0, (-1.0, 1.0), (-1.0, 0.0)).riemann is None  # a ball on a beam
        True
    """

    speed: NotNegative
    error: NotNegative
    velocity_error: NotNegative
    stiffness: Interval
    curvature: Interval = (0.0, 0.0)
    riemann: NotNegative | None = None
    injectivity: Annotated[float, ABOVE_ZERO] = math.inf


class DistanceDecay(NamedTuple):
    """Proved rate at which distances between estimates and truth decrease, with the metric of the proof.

    Attributes:
        rate: Rate ρ [1/s] of the distance; −infinity if nothing is proved.
        radius: Distance D [speed] within which it decreases, in the metric before a correction.
        reach: Bound R = D/√m_h of the distance of positions from the true one, on all relevant curves.
        fastest: Largest speed on these curves.
        before: Weight m₀ of |ξ|² after a correction [1/s²].
        after: Weight m_h of |ξ|² before the next correction [1/s²].
        turning: λ, below π: the effect of curvature.

    Example:
        >>> from covariant.certificates.theory import DistanceBounds, distance_decay
        >>> decay = distance_decay(0.05, 0.9, 4.0, DistanceBounds(1.0, 0.5, 1.0, (-1.0, 1.0), (-1.0, 0.0)))
        >>> decay.after <= decay.before, 0 < decay.turning < 3.1416
        (True, True)
    """

    rate: float
    radius: float
    reach: float
    fastest: float
    before: float
    after: float
    turning: float


NOTHING = DistanceDecay(-math.inf, *(math.nan,) * 6)
"""The result if nothing is proved."""
ROUNDS = 60
"""Iterations for a weight and the radius that depends on it."""
SLACK = 1e-9
"""Relative width of the interval around the weight that must map into itself."""


@check_numbers
def distance_decay(h: Positive, part: Share, sigma: Positive, bounds: DistanceBounds) -> DistanceDecay:
    """Compute the rate at which the distance from the truth provably decreases from sample to sample on a curved space.

    The result concerns only the distance between the estimate and the truth, not the lengths of all curves of
    estimates. So it allows large errors, and no gain is too high for them.

    Args:
        h: Time between two measurements [s].
        part: Part θ of the error that a sample removes, αh/(1 + αh) for `LagrangianMetric`.
        sigma: Ratio σ = β/α of the gains [1/s].
        bounds: Bounds of the true motion, of the first error, of stiffness and curvature.

    Returns:
        The rate, and the metric for which it holds. The assumptions are: the model is exact and has no friction;
        measurements are exact, unwrapped and h apart; the correction takes the shortest geodesic; and the bounds hold
        within the reach of the true positions.

    Raises:
        ValueError: A number is not finite or negative where it may not be, bounds are in the wrong order, or θ is not
            in (0, 1].

    Example:
        A ball on a beam moves at up to 0.5 m/s and is first seen 1 m away, by an observer that does not know its
        velocity:

        >>> from covariant.certificates.theory import DistanceBounds, distance_decay
        >>> distance_decay(0.02, 0.9, 6.0, DistanceBounds(0.5, 1.0, 0.5, (-1.0, 1.0), (-1.0, 0.0))).rate > 0
        True
    """

    def fastest(before: float, rounds: int) -> DistanceDecay:
        """The largest rate with a weight m₀, by bisection, since all conditions are stricter at higher rates."""
        best = _decay(h, part, sigma, bounds, before, 0.0)
        low, high = 0.0, sigma
        for _ in range(rounds if best.rate >= 0 else 0):
            middle = (low + high) / 2
            tried = _decay(h, part, sigma, bounds, before, middle)
            low, high, best = (middle, high, tried) if tried.rate >= 0 else (low, middle, best)
        return best

    scale = sigma**2 + max(map(abs, bounds.stiffness)) + max(map(abs, bounds.curvature)) * bounds.speed**2
    tried = {k: fastest(scale * 2.0**k, 6) for k in range(-10, 15)}
    top = max(tried, key=lambda k: tried[k].rate)
    if tried[top].rate < 0:
        return NOTHING
    finer = [fastest(scale * 2.0 ** (top + i / 4), 16) for i in range(-3, 4)]
    return max([tried[top], *finer], key=lambda one: one.rate)


def _decay(h: float, part: float, sigma: float, bounds: DistanceBounds, before: float, rate: float) -> DistanceDecay:
    """The decay that is proved with a weight m₀ at a rate, or `NOTHING`."""
    low, high = (min(bounds.curvature[0], 0.0), max(bounds.curvature[1], 0.0))

    def moved(m: float) -> tuple[float, float, float]:
        """Radius, largest speed, and weight m_h, if this is assumed to be m."""
        radius = math.sqrt(m * (1 + SLACK)) * bounds.error
        radius = math.hypot(radius, bounds.velocity_error + sigma * bounds.error)
        speed = bounds.speed + math.sqrt(1 + sigma**2 / (m * (1 - SLACK))) * radius
        k = bounds.stiffness[0] + low * speed**2, bounds.stiffness[1] + high * speed**2
        return radius, speed, weight_of(sigma, rate, k).after(before, h)

    m = before
    for _ in range(ROUNDS):
        radius, speed, after = moved(m)
        if abs(after - m) <= SLACK / 2 * m:
            break
        # At most halved per iteration, so that it does not jump to 0: a smaller weight allows larger speeds.
        m = after if after > m / 2 else m / 2
        if m < SLACK * before:
            return NOTHING
    radius, speed, after = moved(m)
    if abs(after - m) > SLACK * m:
        return NOTHING
    m *= 1 - SLACK
    reach = radius / math.sqrt(m)
    x = math.sqrt(high) * reach
    if x >= math.pi or reach >= bounds.injectivity:
        return NOTHING
    left, strip = contracted(part, x)
    riemann = max(map(abs, bounds.curvature)) if bounds.riemann is None else bounds.riemann
    turning = riemann * (bounds.speed + sigma * (left + part) * reach) * radius / m
    if left**2 * before / m + turning * strip / math.pi > 1 or turning * strip > 2 * math.pi:
        return NOTHING
    return DistanceDecay(rate, radius, reach, speed, before, m, turning)


def contracted(part: float, x: float) -> tuple[float, float]:
    """Factors by which a cone of geodesics shrinks when its curves move towards its apex."""
    if x < 1e-4:  # Their limits, with the terms of order x² on the safe side.
        return (1 - part) * (1 + x * x), part * (2 - part) * (1 + x * x)
    rest = (1 - part) * x
    # cos rest − cos x as a product, to avoid cancellation.
    difference = 2 * math.sin((x + rest) / 2) * math.sin((x - rest) / 2)
    return math.sin(rest) / math.sin(x), 2 * difference / (x * math.sin(x))
