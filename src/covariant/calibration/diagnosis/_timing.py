"""Delays of coordinates and scales of inputs that explain the residual accelerations best, by least squares.

A coordinate that lags by τ, read at the stamp t but true at t − τ, is corrected by `q(t + τ)`. The derivatives of the
residual with respect to the τ of every coordinate and to the scale of every input are computed numerically, so that a
few Gauss–Newton steps estimate them together. Their covariance is that of sums over blocks of time (Liang & Zeger
1986), which holds for any correlation within a block.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._residual import Residual, residual
from covariant.calibration.diagnosis._smooth import Smooth
from covariant.models import MechanicalSystem

BLOCKS = 30
ROUNDS = 5
NUDGE = 1e-4
"""Shift [s] of the central differences for derivatives with respect to a delay."""


class Fitted(NamedTuple):
    """Delays that remain in the log and scales of its inputs.

    Without inputs only differences of delays are known: their mean is zero then.

    Attributes:
        delay: Delays (n,) [s].
        scale: Scales (m,); 1 for an input that acts as logged.
        cov: Covariance (n + m, n + m) of both.
        gain: Fraction (m,) by which the sum of squared residuals falls if that input is scaled besides the others.
    """

    delay: Float[np.ndarray, "n"]
    scale: Float[np.ndarray, "m"]
    cov: Float[np.ndarray, "p p"]
    gain: Float[np.ndarray, "m"]


def fit(model: MechanicalSystem, log: Smooth, now: Residual) -> Fitted:
    """Estimate delays and scales by one Gauss–Newton step.

    Args:
        model: The mechanical system.
        log: The smoothed log.
        now: Residual accelerations of the model along it.

    Returns:
        The delays and scales, with their covariance; infinite for one coordinate without inputs.
    """
    n, m = log.q.shape[1], log.u.shape[1]
    columns, used = [], now.used.copy()
    for i in range(n):
        # Central differences: their error is of second order in the shift.
        later, earlier = (residual(model, shifted(log, i, s)) for s in (NUDGE, -NUDGE))
        columns.append(((later.measured - later.modelled) - (earlier.measured - earlier.modelled)) / (2 * NUDGE))
        used &= later.used & earlier.used
    for j in range(m):
        without = residual(model, log._replace(u=np.where(np.arange(m) == j, 0.0, log.u)))
        # The residual falls by the acceleration that the input causes, so its slope in the scale has a minus.
        columns.append(without.modelled - now.modelled)
        used &= without.used
    left, columns = (now.measured - now.modelled)[used], np.stack(columns, axis=2)[used]
    # Without inputs the time at which a motion happens changes nothing: only differences of delays are unknowns.
    free = np.eye(n + m) if m else np.linalg.qr(np.eye(n) - 1 / n)[0][:, : n - 1]
    if free.shape[1] == 0:
        return Fitted(np.zeros(n), np.ones(m), np.full((n + m, n + m), np.inf), np.zeros(m))
    theta, cov, weight = _least_squares(left, columns @ free)
    theta, cov = free @ theta, free @ cov @ free.T
    return Fitted(theta[:n], 1 + theta[n:], cov, _gains(left, columns[..., n:], weight))


def shifted(log: Smooth, i: int, shift: float) -> Smooth:
    """Advance one coordinate of a smoothed log in time, to first order.

    Args:
        log: The smoothed log.
        i: Index of the coordinate.
        shift: Time [s] by which it is advanced, below the step of the grid.

    Returns:
        The log with `q(t + shift)` in that coordinate.
    """

    def advanced(values):
        values = values.copy()
        values[:, i] += shift * np.gradient(values[:, i], log.step)
        return values

    return log._replace(q=advanced(log.q), v=advanced(log.v), a=advanced(log.a))


def _least_squares(left, columns):
    """Minimiser θ (p,) of the squares of `left + columns θ`, its covariance, and the weight (n, n) of the squares."""
    rest = left
    for _ in range(ROUNDS - 1):  # the weight is the inverse covariance of the final residual
        rest = left + columns @ _solved(left, columns, _weight(rest))[0]
    weight = _weight(rest)
    theta, inverse, weighted = _solved(left, columns, weight)
    scores = np.einsum("kjp,kj->kp", weighted, left + columns @ theta)
    sums = np.array([part.sum(axis=0) for part in np.array_split(scores, BLOCKS)])
    # B/(B − 1): the scores sum to zero over all blocks, which makes their squares too small by that.
    return theta, inverse @ (sums.T @ sums) @ inverse * BLOCKS / (BLOCKS - 1), weight


def _weight(rest):
    # Pseudoinverse: coordinates whose residuals are proportional make the covariance singular.
    return np.linalg.pinv(rest.T @ rest / len(rest), rcond=1e-9)


def _solved(left, columns, weight):
    """θ, the inverse of the normal matrix, and the weighted columns."""
    weighted = np.einsum("kip,ij->kjp", columns, weight)
    inverse = np.linalg.pinv(np.einsum("kjp,kjq->pq", weighted, columns), rcond=1e-12)
    # The minimiser of |left + columns θ|², hence the minus.
    return -inverse @ np.einsum("kjp,kj->p", weighted, left), inverse, weighted


def _gains(left, scales, weight):
    """Fraction by which the weighted squares of `left` (K, n) fall by each of the columns (K, n, m) besides the others.

    So several wrong inputs do not hide each other.
    """
    least = _squares(left, scales, weight)
    without = [_squares(left, np.delete(scales, j, axis=2), weight) for j in range(scales.shape[2])]
    return np.array([1 - least / rest if rest > 0 else 0.0 for rest in without])


def _squares(left, columns, weight):
    """Weighted sum of squares that remains with the best multiples of the columns."""
    rest = left + columns @ _solved(left, columns, weight)[0] if columns.shape[2] else left
    return np.einsum("ki,ij,kj->", rest, weight, rest)
