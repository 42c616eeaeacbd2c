"""Gains with which an observer converges from given first errors: the kinetic-energy metric, lifted to the states.

The observer of Sanfelice & Praly's part II in the metric `P = m|ξ|² + |w|²`, w = ζ − σξ, of a Lagrangian system, with
half of the squared distance of the configurations as measure of the output, is

    q̂' = v̂ + α log_q̂ q,   ∇v̂ = S(q̂) + β log_q̂ q,   α = k/m, β = σα.

Along a geodesic of P, with X the velocity of its configuration, V its velocity and p = ∇V − σX,

    ∇p = 0,   ∇X = −R(V, p)X/m,

so that |X| and |p| are constant and `m|X|² + |p|² = 1` per unit length: the configuration only turns, over the length D
by at most ω = κ V D/m, with |R(a, b)c| ≤ κ|a ∧ b||c| and V the largest speed. Three things follow:

- Where velocities alone differ, P contracts at 2σ, for every speed, force and stiffness: the first condition.
- If ω < π/2, and one shortest path leads back, the distance of the configurations grows along the geodesic, and ends at
  an angle of at most ω with it: the second condition, for any number of coordinates.
- If `L_f P ≤ ρ dh⊗dh − 2μP` along it and k ≥ ρω/sin 2ω, then D decays at the rate μ.

ρ is the largest eigenvalue of `2σ sym K + 2μ(m + σ²) + MᵀM/(2σ − 2μ)`, M = m + σ² − 2μσ − K, K = R(·, V)V − ∇S.
It grows as m²/(2σ − 2μ), and ω falls with m towards κe², with e the first error of the position: all speeds and errors
of the velocity have a gain, and all e with κe² < π/2. A farther one may converge, but nothing here excludes that its
whole distance, √m e for large m, turns into velocity before it falls.

Source: an addition; Sanfelice & Praly 2015, section I, and 2016, IEEE TAC 61(10), part II of their work, for the
observer; Aghannan & Rouchon 2003 for the metric; Sasaki 1958, On the differential geometry of tangent bundles of
Riemannian manifolds, for m = 1, σ = 0.
"""

import math
from typing import NamedTuple

from covariant._domains import Positive, check_numbers
from covariant.certificates.theory._implicit_distances import NOTHING, SLACK, DistanceBounds, DistanceDecay
from scalargraph.errors import InputError

STEPS = 40
"""Bisections for a rate."""


class LiftedGain(NamedTuple):
    """What the observer needs to converge in a lifted metric.

    Attributes:
        alpha: Least gain α [1/s]; infinite where no gain is known to do.
        beta: Gain β = σα [1/s²].
        k: Gain k = αm of Sanfelice & Praly [1/s³].
        rho: ρ, the largest that their first condition needs on the set [1/s³].
        turning: ω [rad], below π/2.
        decay: Rate and radius of the distance, and the set that it is about.

    Example:
        >>> from covariant.certificates.theory import DistanceBounds, lifted_gain
        >>> gain = lifted_gain(4.0, 1.0, 0.5, DistanceBounds(0.0, 0.5, 0.0, (-1.0, 1.0)))  # flat: k = ρ/2
        >>> gain.turning, round(gain.k / gain.rho, 6)
        (0.0, 0.5)
    """

    alpha: float
    beta: float
    k: float
    rho: float
    turning: float
    decay: DistanceDecay


@check_numbers
def lifted_gain(m: Positive, sigma: Positive, rate: Positive, bounds: DistanceBounds) -> LiftedGain:
    """Compute the least gain with which `LagrangianMetric` is proved to converge from the bounds' first errors.

    The model has no friction, it is exact, and measurements are exact and dense; `distance_decay` is for samples. Use
    it to see what errors cost: α is nearly proportional to curvature, speed and error. `least_gain` finds the best m.

    Args:
        m: Weight m of |ξ|² [1/s²]; for Q = [[a, c], [c, b]] it is (ab − c²)/b².
        sigma: Ratio σ = β/α of the gains [1/s]; −c/b for Q.
        rate: Rate μ [1/s] at which the distance has to fall, below σ.
        bounds: Bounds of the true motion, of the first error, of stiffness and curvature.

    Returns:
        The gain and the set, infinite and NaN where the geodesics turn by π/2 or more, or by no known angle.

    Raises:
        ValueError: A number is not positive, or the rate is not below σ.

    Example:
        Twice the first error needs more than twice the gain:

        >>> from covariant.certificates.theory import DistanceBounds, lifted_gain
        >>> near = DistanceBounds(0.5, 0.2, 0.5, (-1.0, 1.0), (-1.0, 0.0))
        >>> far = near._replace(error=0.4)
        >>> lifted_gain(20.0, 1.0, 0.5, near).alpha < lifted_gain(20.0, 1.0, 0.5, far).alpha
        True
    """
    if not rate < sigma:
        raise InputError(f"lifted_gain: rate must be below sigma, which is {sigma:g} 1/s; got {rate:g}")
    radius = math.hypot(math.sqrt(m) * bounds.error, bounds.velocity_error + sigma * bounds.error) * (1 + SLACK)
    fastest = bounds.speed + math.sqrt(1 + sigma**2 / m) * radius
    reach = radius / math.sqrt(m)
    low, high = min(bounds.curvature[0], 0.0), max(bounds.curvature[1], 0.0)
    riemann = max(abs(low), high) if bounds.riemann is None else bounds.riemann
    turning = riemann * fastest * radius / m * (1 + SLACK)
    # Beyond a quarter of the way round, distances from a point no longer grow convexly.
    quarter = math.pi / 2 / math.sqrt(high) * (1 - SLACK) if high > 0 else math.inf
    if turning >= math.pi / 2 * (1 - SLACK) or reach >= min(bounds.injectivity, quarter):
        return LiftedGain(math.inf, math.inf, math.inf, math.nan, turning, NOTHING)
    soft, hard = bounds.stiffness[0] + low * fastest**2, bounds.stiffness[1] + high * fastest**2
    weight, q = m + sigma**2, 2 * rate
    mixed = max(abs(weight - q * sigma - soft), abs(weight - q * sigma - hard))
    rho = max(2 * sigma * hard + q * weight + mixed**2 / (2 * sigma - q), 0.0) * (1 + SLACK)
    k = rho * (turning / math.sin(2 * turning) if turning > SLACK else 0.5) * (1 + SLACK)
    return LiftedGain(k / m, sigma * k / m, k, rho, turning, DistanceDecay(rate, radius, reach, fastest, m, m, turning))


@check_numbers
def least_gain(sigma: Positive, rate: Positive, bounds: DistanceBounds) -> LiftedGain:
    """Find the weight m with the least gain of `lifted_gain`.

    Args:
        sigma: Ratio σ = β/α of the gains [1/s].
        rate: Rate μ [1/s] at which the distance has to fall, below σ.
        bounds: Bounds of the true motion, of the first error, of stiffness and curvature.

    Returns:
        The gain and the set; an infinite gain where no weight does.

    Example:
        >>> from covariant.certificates.theory import DistanceBounds, least_gain
        >>> bounds = DistanceBounds(0.5, 0.2, 0.5, (-1.0, 1.0), (-1.0, 0.0))
        >>> 1 < least_gain(1.0, 0.5, bounds).alpha < 100
        True
    """
    scale = sigma**2 + max(map(abs, bounds.stiffness)) + max(map(abs, bounds.curvature)) * bounds.speed**2

    def best(exponents) -> tuple[float, LiftedGain]:
        tried = ((e, lifted_gain(scale * 2.0**e, sigma, rate, bounds)) for e in exponents)
        return min(tried, key=lambda one: one[1].alpha)

    top, _ = best(range(-10, 21))
    return best(top + i / 16 for i in range(-16, 17))[1]


def dense_decay(alpha: Positive, sigma: Positive, bounds: DistanceBounds) -> DistanceDecay:
    """Compute the rate at which distances fall with given gains and dense measurements, or `NOTHING`."""
    low, high, found = 0.0, sigma, NOTHING
    for _ in range(STEPS):
        rate = (low + high) / 2
        gain = least_gain(sigma, rate, bounds)
        low, high, found = (rate, high, gain.decay) if gain.alpha <= alpha else (low, rate, found)
    return found
