"""Positive definiteness of all matrices in an interval matrix: the tests of the prover, with all rounding bounded.

A congruence with floating-point factors brings the interval matrix near the identity, `I − CᵀSC = E`. It is positive
definite where the spectral radius of |E| is below one, by Collatz & Wielandt: `|E| x < x` for some positive x. The
rounding of this test is bounded as well.

Source: Rump 2010, Verification methods, Acta Numerica 19, section 10.8.
"""

import numpy as np
from jaxtyping import Bool

SLACK = 1e-3
"""Relative margin by which |E| x must stay below x, so that another implementation of the test agrees on every box."""
ROUND = 1e-12
"""A generous bound of the relative rounding error of a sum of a few hundred terms."""
TINY = 1e-290
"""Larger than all underflows of such a sum together."""


def definite(
    middle: np.ndarray, radius: np.ndarray, terms: np.ndarray | None = None
) -> tuple[Bool[np.ndarray, "B"], np.ndarray]:
    """Whether all symmetric matrices within `middle ± radius` (B, n, n) are positive definite; and the factors C used.

    With `terms` (B, m, n, n): all those within `middle + Σ wₘ terms[m] ± radius`, |wₘ| ≤ 1.
    """
    c, positive = factors(middle)
    ct, n = np.swapaxes(c, 1, 2), middle.shape[1]
    terms = np.zeros((len(middle), 0, n, n)) if terms is None else terms
    with np.errstate(all="ignore"):
        error = np.abs(np.eye(n) - ct @ middle @ c) + np.abs(ct[:, None] @ terms @ c[:, None]).sum(axis=1)
        rounded = ROUND * (np.abs(middle) + np.abs(terms).sum(axis=1))
        size = np.abs(ct) @ (radius + rounded) @ np.abs(c)
        e = (error + size) * (1 + ROUND) + ROUND
        x = np.ones((len(e), n, 1))
        for _ in range(4):
            x = e @ x + 1e-6
            x = x / x.max(axis=1, keepdims=True)
        below = (e @ x * (1 + ROUND) + TINY <= (1 - SLACK) * x).all(axis=(1, 2))
    return below & positive, c


def indefinite(middle: np.ndarray, radius: np.ndarray) -> Bool[np.ndarray, "B"]:
    """Whether no symmetric matrix within `middle ± radius` (B, n, n) is positive definite: xᵀSx < 0 for some x."""
    finite = np.asarray((np.isfinite(middle) & np.isfinite(radius)).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], middle, 0.0)
    x = np.linalg.eigh(safe)[1][:, :, :1]
    xt = np.swapaxes(x, 1, 2)
    with np.errstate(all="ignore"):
        most = xt @ safe @ x + np.abs(xt) @ (radius + ROUND * np.abs(safe)) @ np.abs(x) * (1 + ROUND) + TINY
    return finite & (most[:, 0, 0] < 0)


def factors(middle: np.ndarray) -> tuple[np.ndarray, Bool[np.ndarray, "B"]]:
    """C (B, n, n) with `Cᵀ middle C` near the identity, whatever the units of the entries; and whether there is one.

    Of all such factors it is the inverse square root: it rotates least, and rotation increases sums of absolute values.
    """
    n = middle.shape[1]
    diagonal = np.abs(np.diagonal(middle, axis1=1, axis2=2))
    units = 1 / np.sqrt(np.where(np.isfinite(diagonal) & (diagonal > TINY), diagonal, 1.0))
    with np.errstate(all="ignore"):
        scaled = middle * units[:, :, None] * units[:, None, :]
    finite = np.asarray(np.isfinite(scaled).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], scaled, np.eye(n)))
    sizes = np.maximum(np.abs(values), np.abs(values).max(axis=1, keepdims=True) * 1e-12 + TINY)
    root = (vectors / np.sqrt(sizes)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return units[:, :, None] * root, finite & (values[:, 0] > 0)
