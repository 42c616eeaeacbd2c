"""Bounds the effect of any bounded noise, from a rate of contraction.

Source: Lohmiller & Slotine 1998, section 3.7 (robustness). For white noise see `calibration.predict_errors`.
"""

import math
from typing import Annotated

import numpy as np

from covariant._domains import FINITE, NotNegative, Positive, check_numbers
from covariant._typing import Number
from covariant.certificates.base._tangent_metric import TwoByTwo, check_q, rate_of
from scalargraph.errors import InputError


@check_numbers
def steady_distance(rate: Positive, disturbance: NotNegative) -> float:
    """Compute the largest final distance between solutions of a contracting flow and a disturbed one: `2 D / λ`.

    Args:
        rate: rate λ [1/s] of squared lengths, positive.
        disturbance: D, the largest length, in the metric, of the disturbance that is added to x'.

    Returns:
        The distance, in the metric.

    Raises:
        ValueError: a rate that is not positive.

    Example:
        >>> from covariant.certificates.base import steady_distance
        >>> steady_distance(rate=4.0, disturbance=0.1)
        0.05
    """
    # d' ≤ −(λ/2) d + D comes to rest at d = 2D/λ.
    return 2 * disturbance / rate


@check_numbers
def error_bounds(
    alpha: Annotated[Number, FINITE],
    beta: Annotated[Number, FINITE],
    q: TwoByTwo,
    rate: Positive,
    noise: NotNegative,
    slope: NotNegative,
) -> tuple[float, float]:
    """Bound the steady errors |ξ| and |ζ| for measurement errors of at most the length `noise`.

    The bounds follow from `steady_distance`: at a distance d, `|ξ| ≤ d √2(Q⁻¹)₁₁` and `|ζ| ≤ d √2(Q⁻¹)₂₂`. They hold
    to first order in the error; `certify(noise=...)` proves a bound for all errors of that size, and computes the slope
    itself.

    Args:
        alpha: gain α [1/s].
        beta: gain β [1/s²].
        q: matrix Q (2, 2) of the metric.
        rate: rate λ [1/s] of squared lengths, at most `rate_of(alpha, beta, q)`.
        noise: largest length of the measurement error, in the metric on configurations.
        slope: an upper bound [1/s²] of `‖∇S‖ + ‖R(·, v)v‖`: the gradient of the acceleration at rest plus the
            curvature term at the largest speed. For a spring it is k/m; it is 0 only without force and curvature.

    Returns:
        Bounds of |ξ| and |ζ|, in units of the metric on configurations, and in these units per second.

    Raises:
        ValueError: a slope or a noise that is not a finite number ≥ 0; a rate that is not positive, or larger than the
            rate of the gains in this metric; a q that is not symmetric positive definite.

    Example:
        >>> from covariant.certificates import error_bounds, lyapunov
        >>> position, velocity = error_bounds(2.0, 2.0, lyapunov(2.0, 2.0), rate=0.5, noise=0.01, slope=1.0)
        >>> position > 0 and velocity > 0
        True
    """
    fastest = rate_of(alpha, beta, q)
    # The tolerance accepts a rate that `rate_of` returned, despite rounding.
    if rate > fastest * (1 + 1e-9):
        raise InputError(f"error_bounds: the gains contract the metric q at {fastest:.6g} 1/s at most; got {rate:g}")
    q, gains = check_q("error_bounds", q), np.array([alpha, beta])
    # The squared length of a vector v is ½ vᵀQv: the error adds (α, β) times it, and changes ∇v̂ by `slope` times it,
    # as force and curvature are evaluated at the measured position.
    distance = steady_distance(rate, noise * (math.sqrt(gains @ q @ gains / 2) + slope * math.sqrt(q[1, 1] / 2)))
    inverse = np.linalg.inv(q)
    # ½ vᵀQv ≤ d² bounds an entry of v by d√(2 (Q⁻¹)ᵢᵢ), the half width of this ellipse.
    return distance * math.sqrt(2 * inverse[0, 0]), distance * math.sqrt(2 * inverse[1, 1])
