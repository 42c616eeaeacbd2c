"""Linear least squares with a covariance from sums over blocks of time, within which errors may be alike in any way.

Source: Liang & Zeger 1986, Longitudinal data analysis using generalized linear models, Biometrika 73(1).
"""

import numpy as np
from jaxtyping import Float

from covariant.calibration.diagnosis._suspicion import BLOCKS, blocks_of


def weighted_least_squares(
    left: Float[np.ndarray, "K n"],
    columns: Float[np.ndarray, "K n p"],
    weight: Float[np.ndarray, "n n"],
    blocks: np.ndarray | None = None,
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p p"]]:
    """Minimiser θ of the weighted squares of `left − columns θ`, with its covariance from sums over blocks of rows.

    The block (K,) of each row is by default one of equal parts.
    """
    weighted = np.einsum("kip,ij->kjp", columns, weight)
    # Columns of unit length: delays, scales and offsets are of other sizes.
    size = np.sqrt(np.maximum(np.einsum("kjp,kjp->p", weighted, columns), 1e-300))
    columns, weighted = columns / size, weighted / size
    inverse = np.linalg.pinv(np.einsum("kjp,kjq->pq", weighted, columns), rcond=1e-10)
    theta = inverse @ np.einsum("kjp,kj->p", weighted, left)
    scores = np.einsum("kjp,kj->kp", weighted, left - columns @ theta)
    blocks = blocks_of(len(left)) if blocks is None else blocks
    sums = np.array([scores[blocks == block].sum(axis=0) for block in range(BLOCKS)])
    # B/(B − 1): the scores sum to zero over all blocks, which makes their squares too small by that.
    cov = inverse @ (sums.T @ sums) @ inverse * BLOCKS / (BLOCKS - 1)
    return theta / size, cov / np.outer(size, size)
