"""Builds the metric on the tangent bundle in which an intrinsic observer contracts.

A variation (δq, δv) of a state (q, v) has the components `ξ = δq` and `ζ = δv + Γ(v, δq)`, both tangent vectors at q.
The squared length is `½(a<ξ,ξ> + 2c<ξ,ζ> + b<ζ,ζ>)`, where the matrix `Q = [[a, c], [c, b]]` is chosen for the gains.
For Q = I it is half of the metric of Sasaki (1958).

Source: Aghannan & Rouchon 2003, section IV and equations (6), (11); their dV/dt lacks a factor ½.
"""

import contextlib
import math
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._domains import FINITE, POSITIVE, Finite, Positive, check_numbers
from covariant._typing import MatrixField, Number, Numbers
from covariant.certificates.base._contraction import StateMetric
from covariant.certificates.base._properties import need_no_loops
from covariant.geometry import as_space
from scalargraph.errors import InputError

TwoByTwo = Float[np.ndarray, "2 2"]


@check_numbers
def error_matrix(alpha: Annotated[Number, FINITE], beta: Annotated[Number, FINITE]) -> TwoByTwo:
    """Return the matrix A of the error law ξ' = ζ − αξ, ζ' = −βξ of small errors in a parallel frame, equation (10).

    Args:
        alpha: gain α [1/s].
        beta: gain β [1/s²].

    Returns:
        `A = [[−α, 1], [−β, 0]]`.

    Example:
        >>> from covariant.certificates.base import error_matrix
        >>> error_matrix(2.0, 3.0).tolist()
        [[-2.0, 1.0], [-3.0, 0.0]]
    """
    return np.array([[-alpha, 1.0], [-beta, 0.0]])


@check_numbers
def lyapunov(
    alpha: Annotated[Number, FINITE], beta: Annotated[Number, FINITE], rate: Finite = 0.0, weight: Positive = 1.0
) -> TwoByTwo:
    """Solve `AᵀQ + QA + rate Q = −diag(1, weight)` for Q, where A is `error_matrix(alpha, beta)`.

    With rate 0 and weight 1, the defaults, Q is the metric of the paper.

    Use it to choose the metric of a certificate from the gains. A larger `rate` proves faster convergence, but its
    metric is worse conditioned, which makes the region smaller. The rate refers to squared lengths. The entries of Q
    have different units, since they belong to position and velocity errors.

    Args:
        alpha: gain α [1/s].
        beta: gain β [1/s²].
        rate: rate [1/s] of squared lengths, below twice the decay rate of the slower pole.
        weight: positive weight of the velocity error.

    Returns:
        Q (2, 2), symmetric positive definite.

    Raises:
        ValueError: gains that do not converge, or converge no faster than `e^(−rate t/2)`; a weight that is not
            positive; or a matrix that is not positive definite because of rounding.

    Example:
        >>> from covariant.certificates import lyapunov
        >>> lyapunov(1.0, 1.0).round(6).tolist()
        [[1.0, -0.5], [-0.5, 1.5]]
    """
    return _solutions(alpha, beta, rate, np.array([weight]))[0]


def _solutions(alpha: Number, beta: Number, rate: Number, weights: np.ndarray) -> np.ndarray:
    """The matrices (k, 2, 2) that `lyapunov` returns for weights (k,)."""
    # A + λ/2 I must be stable: AᵀQ + QA + λQ = (A + λ/2 I)ᵀQ + Q(A + λ/2 I).
    shifted = error_matrix(alpha, beta) + rate / 2 * np.eye(2)
    if not (np.linalg.eigvals(shifted).real < 0).all():
        slowest = -2 * np.linalg.eigvals(error_matrix(alpha, beta)).real.max()
        raise InputError(
            f"gains alpha {alpha:g}, beta {beta:g} shrink squared lengths at {slowest:.4g} 1/s at best; "
            f"ask for a rate below that; got {rate:g}"
        )
    # The Lyapunov equation is a linear system in the entries of Q, row by row, solved for all weights at once.
    operator = np.kron(shifted.T, np.eye(2)) + np.kron(np.eye(2), shifted.T)
    zero = np.zeros_like(weights)
    right = np.stack([np.ones_like(weights), zero, zero, weights], axis=1)
    with contextlib.suppress(np.linalg.LinAlgError):
        q = np.linalg.solve(operator, -right[..., None]).reshape(-1, 2, 2)
        q = (q + q.transpose(0, 2, 1)) / 2
        np.linalg.cholesky(q)
        if np.isfinite(q).all():
            return q
    raise InputError(
        f"gains alpha {alpha:g}, beta {beta:g} at rate {rate:g} 1/s: rounding leaves no positive definite matrix; "
        "ask for a lower rate, or for gains of less different size"
    )


@check_numbers
def rate_of(alpha: Annotated[Number, FINITE], beta: Annotated[Number, FINITE], q: Numbers) -> float:
    """Compute the largest λ with `AᵀQ + QA ≤ −λQ`: the rate of squared lengths at zero position error, q̂ = q.

    Args:
        alpha: gain α [1/s].
        beta: gain β [1/s²].
        q: matrix Q (2, 2) of the metric.

    Returns:
        λ [1/s].

    Raises:
        ValueError: a gain that is not finite, or a q that is not symmetric positive definite.

    Example:
        >>> from covariant.certificates import lyapunov
        >>> from covariant.certificates.base import rate_of
        >>> round(rate_of(1.0, 1.0, lyapunov(1.0, 1.0)), 4)
        0.5528
    """
    q = check_q("rate_of", q)
    a = error_matrix(alpha, beta)
    # With Q = LLᵀ, the eigenvalues of L⁻¹(AᵀQ + QA)L⁻ᵀ are the eigenvalues relative to Q; the largest one decides.
    half = np.linalg.inv(np.linalg.cholesky(q))
    return float(-np.linalg.eigvalsh(half @ (a.T @ q + q @ a) @ half.T)[-1])


@check_numbers
def conditioning(beta: Annotated[Number, POSITIVE], q: Numbers) -> float:
    """Compute the condition number of Q, with velocities in units of √β times those of positions.

    With these units it is dimensionless.

    Args:
        beta: gain β [1/s²], positive.
        q: matrix Q (2, 2) of the metric.

    Returns:
        The condition number, at least 1.

    Raises:
        ValueError: a beta that is not positive, or a q that is not symmetric positive definite.

    Example:
        >>> from covariant.certificates.base import conditioning
        >>> round(conditioning(4.0, [[4.0, 0.0], [0.0, 1.0]]), 6)
        1.0
    """
    return float(_conditions(beta, check_q("conditioning", q)[None])[0])


def _conditions(beta: Number, q: np.ndarray) -> np.ndarray:
    """Condition numbers, as by `conditioning`, of matrices (k, 2, 2)."""
    scale = np.diag([1.0, math.sqrt(beta)])
    return np.linalg.cond(scale @ q @ scale)


def check_q(whose: str, q: Numbers) -> TwoByTwo:
    """Convert the matrix Q to an array, and check it."""
    try:
        matrix = np.asarray(q, float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape == (2, 2) and np.isfinite(matrix).all():
        with contextlib.suppress(np.linalg.LinAlgError):
            # The off-diagonal entries may differ by rounding, as after products of matrices.
            if abs(matrix[0, 1] - matrix[1, 0]) <= 1e-12 * np.abs(matrix).max():
                np.linalg.cholesky(matrix)
                return (matrix + matrix.T) / 2
    shown = " ".join(str(q).split())
    raise InputError(f"{whose}: q must be a symmetric positive definite matrix (2, 2) of finite numbers; got {shown}")


@check_numbers
def optimal_lyapunov(alpha: Annotated[Number, FINITE], beta: Annotated[Number, FINITE], rate: Finite) -> TwoByTwo:
    """Find the best conditioned matrix of `lyapunov` for a rate, over a grid of weights.

    Args:
        alpha: gain α [1/s].
        beta: gain β [1/s²].
        rate: rate [1/s] of squared lengths, below twice the decay rate of the slower pole.

    Returns:
        Q (2, 2) with the smallest condition number.

    Raises:
        ValueError: as for `lyapunov`.

    Example:
        >>> from covariant.certificates import lyapunov, optimal_lyapunov
        >>> from covariant.certificates.base import conditioning
        >>> conditioning(2.0, optimal_lyapunov(2.0, 2.0, 1.0)) <= conditioning(2.0, lyapunov(2.0, 2.0, 1.0))
        True
    """
    alpha, beta = float(alpha), float(beta)
    lyapunov(alpha, beta, rate)
    # A weight of 1/β weighs both errors equally in the units of `conditioning`; the grid is around it.
    # 241 weights in twelve decades are 12 % apart, so the best of them is close to the optimum, which is flat.
    matrices = _solutions(alpha, beta, rate, np.logspace(-6, 6, 241) / beta)
    return matrices[np.argmin(_conditions(beta, matrices))]


@check_numbers
def tangent_metric(metric: MatrixField, q: Annotated[TwoByTwo, FINITE]) -> StateMetric:
    """Build the metric on states x = (q, v) from a metric on configurations and a matrix Q, in the frame (ξ, ζ).

    Its squared length is `½(a<ξ,ξ> + 2c<ξ,ζ> + b<ζ,ζ>)`. For Q = I it is half of Sasaki's metric, in which horizontal
    displacements ξ (v transported in parallel) and vertical ones ζ are orthogonal. Of another Q, a and b scale the two,
    and c ≠ 0 tilts them against each other, as the feedback couples position and velocity errors. It is positive
    definite on all of the tangent bundle TQ, at every velocity, wherever the metric on configurations is.

    Source: Sasaki 1958, On the differential geometry of tangent bundles of Riemannian manifolds, Tôhoku Math. J. 10;
    Aghannan & Rouchon 2003, section IV.

    Args:
        metric: metric `q (n,) -> (n, n)` on configurations, or a space of `covariant.geometry`.
        q: matrix Q (2, 2), as from `lyapunov`.

    Returns:
        The metric on states (2n,).

    Raises:
        ValueError: the space is a `Leaf`; the metric of the whole space would also count errors normal to it.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import tangent_metric
        >>> metric = tangent_metric(lambda q: jnp.eye(1), 2 * np.eye(2))
        >>> metric(jnp.array(0.0), jnp.zeros(2)).tolist()
        [[1.0, 0.0], [0.0, 1.0]]
    """
    geometry = as_space(metric)
    need_no_loops("tangent_metric", geometry)
    lower = np.array([[0.0, 0.0], [1.0, 0.0]])

    def connection(x):
        position, v = jnp.split(x, 2)
        directions = jnp.eye(position.shape[0], dtype=x.dtype)
        return jax.vmap(lambda e: geometry.connection(position, v, e), out_axes=1)(directions)

    # Θ = [[I, 0], [Γ, I]], whose inverse has −Γ: hence the sign.
    def coframe(t, x, sign=1.0):
        return jnp.eye(x.shape[0], dtype=x.dtype) + sign * jnp.kron(jnp.asarray(lower, x.dtype), connection(x))

    def gram(t, x):
        # V = ½(a|ξ|² + 2c<ξ, ζ> + b|ζ|²) is the squared length, hence the half.
        return jnp.kron(jnp.asarray(q / 2, x.dtype), geometry(jnp.split(x, 2)[0]))

    return StateMetric(coframe, lambda t, x: coframe(t, x, -1.0), gram, geometry)


def lowered_christoffel(change: Float[Array, "n n n"]) -> Float[Array, "n n n"]:
    """Compute `Γ_ijk = ½(∂_i g_jk + ∂_j g_ik − ∂_k g_ij)`, of the first kind, from `change[i, j, k] = ∂_k g_ij`."""
    return (jnp.transpose(change, (2, 0, 1)) + jnp.transpose(change, (0, 2, 1)) - change) / 2
