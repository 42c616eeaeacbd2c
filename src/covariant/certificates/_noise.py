"""Bounds of the effect of noise from a rate of contraction: for any noise, not only for white noise.

Source: Lohmiller & Slotine 1998, section 3.7 (robustness). For white noise see `calibration.predict_errors`.
"""

import math

import numpy as np

from covariant._typing import Number
from covariant.certificates._tangent_metric import TwoByTwo, check_q, rate_of


def steady_distance(rate: float, disturbance: float) -> float:
    """The largest final distance between solutions of a contracting flow and of a disturbed one: `2 D / λ`.

    - `rate`: λ [1/s], of squared lengths.
    - `disturbance`: D, the largest length in the metric of what is added to x'.

    Raises `ValueError` for a rate that is not positive.
    """
    if not rate > 0:
        raise ValueError(f"a bound needs a positive rate; got {rate:g}")
    return 2 * disturbance / rate


def noise_disturbance(alpha: Number, beta: Number, q: TwoByTwo, noise: float, slope: float) -> float:
    """The length, in the metric of q, of what a measurement error of length `noise` adds to the observer's flow.

    To first order the error b adds `αb` to q̂' and `βb` to ∇v̂, a vector of length `|b| √½(aα² + 2cαβ + bβ²)`. Since
    force and curvature are evaluated at the measured position, it adds up to `slope |b|` more to ∇v̂. Raises
    `ValueError` where q is not symmetric positive definite.
    """
    q, gains = check_q("noise_disturbance", q), np.array([alpha, beta])
    return noise * (math.sqrt(gains @ q @ gains / 2) + slope * math.sqrt(q[1, 1] / 2))


def error_bounds(
    alpha: Number, beta: Number, q: TwoByTwo, rate: float, noise: float, slope: float
) -> tuple[float, float]:
    """Bounds of the steady errors |ξ| and |ζ|, in metric units, for measurement errors no longer than `noise`.

    They follow from `steady_distance`: a state at distance d has `|ξ| ≤ d √2(Q⁻¹)₁₁` and `|ζ| ≤ d √2(Q⁻¹)₂₂`. They hold
    to first order in the error; `certify(noise=...)` proves a bound for all errors of that size, and finds the slope
    itself.

    - `slope` [1/s²]: an upper bound of `‖∇S‖ + ‖R(·, v)v‖`, of the gradient of the acceleration at rest and the
      curvature at the largest speed. For a spring it is k/m; it is 0 only without force and curvature.

    Raises `ValueError` for a slope or a noise that is not a finite number ≥ 0, a rate that is not positive or larger
    than that of the gains in this metric, or a q that is not symmetric positive definite.
    """
    for name, value in (("slope", slope), ("noise", noise)):
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(f"error_bounds: {name} must be a finite number, zero or more; got {value!r}")
    fastest = rate_of(alpha, beta, q)
    if rate > fastest * (1 + 1e-9):
        raise ValueError(f"error_bounds: the gains contract the metric q at {fastest:.6g} 1/s at most; got {rate:g}")
    distance = steady_distance(rate, noise_disturbance(alpha, beta, q, noise, slope))
    inverse = np.linalg.inv(check_q("error_bounds", q))
    return distance * math.sqrt(2 * inverse[0, 0]), distance * math.sqrt(2 * inverse[1, 1])
