"""The least gain of the observer without compensation in continuous time; any gain above it converges too.

The observer is `q̂' = v̂ − αξ, ∇_q̂' v̂ = S(q̂) − βξ`, with `α = kQ22/Δ, β = −kQ12/Δ, Δ = det Q`: the limit of
`ImplicitGeodesic` for samples that follow one another at once. Its error obeys `ξ' = ζ − αξ, ζ' = −Kξ − βξ` to first
order, with `K = R(·, v)v − ∇S`, and `V = Q11|ξ|² + 2Q12<ξ, ζ> + Q22|ζ|²` changes as

    V' = −2k|ξ|² + 2Q11<ξ, ζ> + 2Q12|ζ|² − 2Q12<ξ, Kξ> − 2Q22<ζ, Kξ>,

in which the gain k stands with |ξ|² alone. With c = −2Q12 − ρQ22 > 0 and m = (Q11 + ρQ12)I − Q22 K, completing the
square in ζ gives V' ≤ −ρV for all errors if and only if

    2k ≥ λmax(−2Q12 sym K + ρQ11 I + mᵀm/c).

Source: an addition; the metric is that of Aghannan & Rouchon 2003, equation (11).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class ContinuousGains(NamedTuple):
    """Gains in continuous time for a rate of the error.

    Attributes:
        gain: Gain k; any larger one has the same rate.
        alpha: Gain α = kQ22/Δ [1/s].
        beta: Gain β = −kQ12/Δ [1/s²].

    Example:
        >>> import numpy as np
        >>> from covariant.observers import least_gain
        >>> gains = least_gain(np.zeros((1, 1)), np.array([[1.0, -0.5], [-0.5, 1.0]]))
        >>> round(gains.beta / gains.alpha, 9)
        0.5
    """

    gain: float
    alpha: float
    beta: float


def least_gain(stiffness: Float[np.ndarray, "n n"], q: Float[np.ndarray, "2 2"], rate: float = 0.0) -> ContinuousGains:
    """The least gain k at which V falls at a rate, at one state; all gains above it do as well.

    A bound for many states is the largest of theirs.

    Args:
        stiffness: K = R(·, v)v − ∇S [1/s²] in an orthonormal frame; it need not be symmetric.
        q: Matrix Q of V, positive definite with Q12 < 0.
        rate: Rate ρ [1/s] of V, twice that of the error, in [0, −2Q12/Q22).

    Returns:
        The gain, with α and β.

    Raises:
        ValueError: Q is not positive definite with Q12 < 0, or ρ is out of its range.

    Example:
        A pendulum of 1 m, hanging and standing:

        >>> import numpy as np
        >>> from covariant.observers import least_gain
        >>> q = np.array([[1.0, -0.2], [-0.2, 0.05]])
        >>> [round(least_gain(np.array([[k]]), q).gain, 3) for k in (9.81, -9.81)]
        [2.286, 0.815]
    """
    square = float(q[0, 0]), float(q[0, 1]), float(q[1, 1])
    q11, q12, q22 = square
    determinant, c = q11 * q22 - q12**2, -2 * q12 - rate * q22
    fine = all(map(math.isfinite, square)) and q12 == q[1, 0] and q22 > 0 and determinant > 0 and q12 < 0
    if not (fine and rate >= 0 and c > 0):
        raise ValueError(
            f"least_gain: needs Q positive definite with Q12 < 0, and 0 ≤ rate < −2 Q12/Q22; got Q = {q.tolist()}, "
            f"rate = {rate}"
        )
    unit = np.eye(len(stiffness))
    m = (q11 + rate * q12) * unit - q22 * stiffness
    needed = -q12 * (stiffness + stiffness.T) + rate * q11 * unit + m.T @ m / c
    k = max(float(np.linalg.eigvalsh(needed)[-1]) / 2, 0.0)
    return ContinuousGains(k, k * q22 / determinant, -k * q12 / determinant)
