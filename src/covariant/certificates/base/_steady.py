"""Computes how factor, noise, unknown forces and errors of predictions reduce rate and accuracy.

Source: Lohmiller & Slotine 1998, section 3.7 (robustness). For white noise see `calibration.predict_errors`.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from covariant._domains import NotNegative, Positive, check_numbers
from covariant.certificates.base._box import Given
from covariant.certificates.base._claims import AbstractClaim, CorrectionClaim, DisturbanceClaim, MissingClaim, select
from covariant.certificates.base._radius_recursion import Recursion
from covariant.certificates.base._sampling import Loss, Sampling


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


def loss_of(
    sampling: Sampling | None, q: Float[np.ndarray, "2 2"], rate: float, claims: Sequence[AbstractClaim]
) -> Loss:
    """Compute the loss of rate by the factor of the correction that runs."""
    missing = select(claims, MissingClaim)
    if sampling is None or not missing:
        return Loss(0.0, 0.0)
    return Loss.of(sampling, q, rate, missing[0].square, missing[0].limit)


def steady_of(
    sampling: Sampling | None,
    q: Float[np.ndarray, "2 2"],
    rate: float,
    given: Given,
    claims: Sequence[AbstractClaim],
) -> float:
    """Compute the largest distance that noise, disturbance and errors of predictions alone can cause."""
    if sampling is None:
        return steady_distance(rate, disturbance_length(given, claims))
    disturbed = given.noise.any() or given.disturbance.any()
    if disturbed and len(select(claims, CorrectionClaim)) <= sampling.lost:
        return math.inf
    return Recursion.of(sampling, q, rate, given, claims).steady


def disturbance_sizes(given: Given) -> Float[np.ndarray, "two_n"]:
    """Compute the largest errors of the measured position and of the force.

    The error of the force is the unmodelled force, plus the change of the modelled force by an error of the position at
    which it is evaluated. Together the errors lie in a ball of radius √m relative to these sizes, where m is the number
    of sizes that are not zero.
    """
    noise, unknown, slopes = given.noise, given.disturbance, given.slopes
    # Σ_j |∂f_i/∂q_j| · noise_j bounds the change of force i; the factor covers the rounding of this sum.
    induced = (slopes * noise).sum(axis=1) * (1 + 1e-12)
    return np.concatenate([noise, unknown + induced])


def disturbance_length(given: Given, claims: Sequence[AbstractClaim]) -> float:
    """Bound the length D that noise and disturbance add to the flow."""
    count = np.count_nonzero(disturbance_sizes(given))
    squares = [claim.square for claim in select(claims, DisturbanceClaim)]
    # The errors lie in a ball of radius √count, whereas the claim is about the unit ball; the factor covers rounding.
    return math.sqrt(count * squares[0]) * (1 + 1e-12) if squares else math.inf if count else 0.0
