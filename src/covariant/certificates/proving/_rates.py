"""Chooses the metric and the rate that `certify` proves by default."""

import numpy as np

from covariant._domains import FINITE, POSITIVE
from covariant._typing import Numbers
from covariant.certificates.base import Intrinsics, TwoByTwo, check_q, error_matrix, optimal_lyapunov, rate_of


def metric_and_rates(
    observer: Intrinsics, q: Numbers | None, rate: float | None, sampled: bool, noisy: bool
) -> tuple[TwoByTwo, *tuple[float, ...]]:
    """Choose the metric and the rate to prove."""
    alpha, beta = float(observer.alpha), float(observer.beta)
    for name, gain in (("alpha", alpha), ("beta", beta)):
        FINITE.check("certify", f"{name} of the observer", gain)
    best = -2 * float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
    matrix = optimal_lyapunov(alpha, beta, best * 2 / 3) if q is None else check_q("certify", q)
    default = best / 10 if sampled else rate_of(alpha, beta, matrix) / 2
    target = default if rate is None else float(rate)
    POSITIVE.check("certify", "the rate", target)
    # Fast rates forget noise sooner, but fewer metrics allow them: the smallest bound lies in between.
    return matrix, target, *((2 * target, 4 * target, 6 * target) if sampled and noisy and rate is None else ())
