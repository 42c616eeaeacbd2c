"""Robust nonlinear least squares by blocks: weights, solver, covariance, and what the data do not determine.

Errors come in blocks, such as windows of a log: within a block they may be alike, between blocks they are independent.
All blocks share p unknowns z, and each may have k unknowns s to itself, such as the motion at its start. These are
eliminated block by block, so that the system to be solved has the size p. `scipy.optimize.least_squares` with a sparse
Jacobian needs 2.5 to 5 times as long: for 12 shared unknowns and 31 blocks of 4, 53 evaluations in place of 21.

Source: Marquardt 1963, and Madsen, Nielsen & Tingleff 2004, section 3.2, for steps; Huber 1981, Robust Statistics,
sections 6.3 and 7.6, for weights and covariance; White 1982 for the covariance from blocks.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.signals import AnyArray

HUBER = 3.0
"""Size of an error, in units of its scale, beyond which its influence is nearly constant: it is an outlier."""
STD_OF_MEDIAN = 1.4826
"""Standard deviation over the median of sizes, 1/Φ⁻¹(3/4): half of all normal deviates are within 0.6745 of it."""
PRIOR = 3.0
"""Standard deviation of the prior, in usual sizes or logarithms of ratios: a first value is right within a factor of
e³. It decides only where the data say nothing; a logarithm known to 10 % it changes by a thousandth of that."""
MOST_STEPS = 25
"""Largest number of Levenberg–Marquardt steps of a search."""
TOLERANCE = 3e-3
"""A step that is predicted to lower half the sum of squares, in units of the errors' variance, by less ends a search:
it changes no unknown by more than a hundredth of its standard error."""
UNKNOWN = 1.0
"""A combination of unknowns with a larger standard error is not determined: a logarithm not even within a factor e."""
FIXING = 1e3
"""Weight that fixes an undetermined combination, in scales of the errors."""
SMALL = 0.01
"""Entries of an undetermined combination below this fraction of the largest are set to zero."""
ROUNDING = 1e-11
"""Information about a combination, relative to the greatest, that is nothing but rounding."""

NumpyArray = np.ndarray


def robust(e: Any) -> tuple[Any, Any]:
    """Pseudo-Huber loss of errors in units of their scale, and weights w: its slope is w e, its curvature w³.

    The curvature is below the weight, so that a quadratic function with the weights majorises the loss.
    """
    weight = (1 + (e / HUBER) ** 2) ** -0.5
    # δ² (√(1 + (e/δ)²) − 1) as a quotient, since the difference would cancel for small e.
    return e**2 / (1 + 1 / weight), weight


def block_covariance(
    scores: Float[NumpyArray, "B p"],
    curvature: Float[NumpyArray, "p p"],
    inverse: Float[NumpyArray, "p p"],
    prior: Float[NumpyArray, "p p"] | float = 0.0,
) -> Float[NumpyArray, "p p"]:
    """Covariance `H⁻¹ (Σ g gᵀ + P) H⁻¹`, from the score g of each block, the curvature of the loss, and H⁻¹."""
    # Of B blocks as many are free as the fit leaves: the trace is the number of unknowns that the data determine.
    free = max(len(scores) - np.trace(inverse @ curvature), 1.0)
    return inverse @ (len(scores) / free * scores.T @ scores + prior) @ inverse


class Blocks(NamedTuple):
    """The loss of each block and its derivatives in z and s, and what else the errors are needed for.

    `ss`, `sz`, `zz` majorise the second derivatives, and are used for steps; `curved` are those of the loss itself.
    """

    loss: Float[AnyArray, "*B"]
    s: Float[AnyArray, "*B k"]
    z: Float[AnyArray, "*B p"]
    ss: Float[AnyArray, "*B k k"]
    sz: Float[AnyArray, "*B k p"]
    zz: Float[AnyArray, "*B p p"]
    curved: tuple[Any, Any, Any]
    rest: Any = None

    @classmethod
    def one(cls, e: Float[Array, "r"], slope: Float[Array, "r p_and_k"], p: int, rest: Any) -> "Blocks":
        """A block, from its errors and their derivatives in z (p,) and s."""
        loss, weight = robust(e)
        gradient = slope.T @ (weight * e)

        def parts(w: Array) -> tuple[Array, Array, Array]:
            full = slope.T @ (w[:, None] * slope)
            return full[p:, p:], full[p:, :p], full[:p, :p]

        return cls(jnp.sum(loss), gradient[p:], gradient[:p], *parts(weight), parts(weight**3), rest)

    @property
    def informations(self) -> Float[NumpyArray, "B p p"]:
        """Second derivatives (p, p) of the loss of each block in z with the best s: the Schur complement of these."""
        ss, sz, zz = self.curved
        return zz - np.swapaxes(sz, 1, 2) @ np.linalg.solve(ss + _ridge(ss), sz)

    @property
    def information(self) -> Float[NumpyArray, "p p"]:
        """Second derivatives (p, p) of the whole loss in z."""
        return np.sum(self.informations, axis=0)

    def inverse(self, fixed: NumpyArray) -> Float[NumpyArray, "p p"]:
        """Covariance of z for independent errors with combinations fixed; zero along these."""
        free = _span(np.eye(len(fixed)) - fixed)
        if not free.shape[1]:
            return np.zeros_like(fixed)
        information = free.T @ self.information @ free
        size = np.sqrt(np.diagonal(information))
        return free @ (np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)) @ free.T

    def covariance(self, fixed: NumpyArray) -> Float[NumpyArray, "p p"]:
        """Covariance of z with combinations fixed, robust to errors that are alike within a block."""
        return block_covariance(np.asarray(self.z), self.information, self.inverse(fixed))

    @property
    def overdispersion(self) -> float:
        """Factor by which errors that are alike within a block enlarge variances on average, and chance the loss."""
        inverse, scores = self.inverse(self.undetermined), np.asarray(self.z)
        rank = max(1.0, float(np.trace(inverse @ self.information)))
        return max(1.0, float(np.einsum("bp,pq,bq->", scores, inverse, scores)) / rank)

    @property
    def undetermined(self) -> Float[NumpyArray, "p p"]:
        """Projection of z on the combinations that the data do not determine.

        First those for which even independent errors would leave a standard error above `UNKNOWN`, then those for which
        the actual errors, alike within each block, do.
        """
        eigenvalues, vectors = np.linalg.eigh(self.information)
        # Information below 1/UNKNOWN² is a standard error above UNKNOWN; the other bound is for what is rounding.
        basis = vectors[:, eigenvalues < max(UNKNOWN**-2, ROUNDING * eigenvalues[-1])]
        eigenvalues, vectors = np.linalg.eigh(self.covariance(basis @ basis.T))
        basis = np.linalg.qr(np.concatenate([basis, vectors[:, eigenvalues > UNKNOWN**2]], axis=1))[0]
        return basis @ basis.T


@runtime_checkable
class Residuals(Protocol):
    """What a search minimises."""

    def blocks(self, z: NumpyArray, s: NumpyArray) -> Blocks:
        """The loss and its derivatives at z (p,) and s (B, k)."""
        ...

    def moved(self, z: NumpyArray, dz: NumpyArray) -> NumpyArray:
        """Unknowns (p,) after a step dz from z."""
        ...


class Fixed(NamedTuple):
    """Undetermined combinations as a projection `directions` (p, p) of z, fixed where z is `at` (p,)."""

    directions: Float[NumpyArray, "p p"]
    at: Float[NumpyArray, "p"]

    @classmethod
    def nothing(cls, count: int) -> "Fixed":
        return cls(np.zeros((count, count)), np.zeros(count))

    def beside(self, j: int, value: float) -> "Fixed":
        """The same with unknown j fixed at a value too."""
        unit = np.eye(len(self.at))[j]
        directions = self.directions + np.outer(unit, unit)
        # `at` acts only through directions @ at, so that any point with this goal will do: the pseudoinverse gives one.
        return Fixed(directions, np.linalg.pinv(directions) @ (self.directions @ self.at + value * unit))


class Point(NamedTuple):
    """A point of a search: z (p,), s (B, k), and the loss with its derivatives there."""

    z: Float[NumpyArray, "p"]
    s: Float[NumpyArray, "B k"]
    blocks: Blocks

    @classmethod
    def at(cls, residuals: Residuals, z: NumpyArray, s: NumpyArray) -> "Point":
        return cls(z, s, residuals.blocks(z, s))

    def loss(self, fixed: Fixed) -> float:
        """Loss with the prior, and with the penalty that fixes undetermined combinations."""
        deviation = self.z - fixed.at
        prior = np.sum(self.z**2) / (2 * PRIOR**2) + FIXING**2 * deviation @ fixed.directions @ deviation / 2
        return float(np.sum(self.blocks.loss) + prior)


def minimise(
    residuals: Residuals,
    point: Point,
    fixed: Fixed,
    progress: Callable[[int], object] = lambda _: None,
    most: int = MOST_STEPS,
) -> tuple[Point, int]:
    """Minimise the loss from a point by Levenberg–Marquardt steps; returns the last point and their number."""
    # Relative to the diagonal: the first step is nearly the full one of Gauss and Newton (Madsen et al., 3.2).
    damping, growth = 1e-3, 2.0
    for k in range(most):
        progress(k)
        dz, ds, promised = _step(point, fixed, damping)
        if promised < TOLERANCE:
            return point, k
        tried = Point.at(residuals, residuals.moved(point.z, dz), point.s + ds)
        gain = (point.loss(fixed) - tried.loss(fixed)) / promised
        if gain > 0:  # False where the trial is not finite
            point, growth = tried, 2.0
            # Nielsen's rule: the better the prediction of the fall was, the smaller the damping (Madsen et al., 3.2).
            damping *= max(1 / 10, 1 - (2 * min(gain, 1.0) - 1) ** 3)
        else:
            damping, growth = damping * growth, 2 * growth
    return point, most


def _step(point: Point, fixed: Fixed, damping: float) -> tuple[NumpyArray, NumpyArray, float]:
    """A damped Gauss–Newton step of z and s, and the predicted fall of the loss."""
    b = point.blocks
    k, p = b.s.shape[1], len(point.z)
    ss = b.ss * np.where(np.eye(k, dtype=bool), 1 + damping, 1.0) + _ridge(b.ss)
    # Schur complement: s of each block is eliminated before z is solved for.
    back = np.linalg.solve(ss, np.concatenate([b.sz, b.s[:, :, None]], axis=2))
    zz = np.sum(b.zz, axis=0)
    fixing = FIXING**2 * fixed.directions
    prior = np.eye(p) / PRIOR**2 + fixing
    reduced = zz + damping * np.diag(np.diagonal(zz)) + prior - np.einsum("wkp,wkq->pq", b.sz, back[:, :, :p])
    slope = np.sum(b.z, axis=0) + prior @ point.z - fixing @ fixed.at
    size = np.sqrt(np.diagonal(reduced))
    right = slope - np.einsum("wkp,wk->p", b.sz, back[:, :, p])
    # Scaled to a unit diagonal, since the sensitivities differ by orders of magnitude.
    dz = -np.linalg.solve(reduced / np.outer(size, size), right / size) / size
    ds = -back[:, :, p] - back[:, :, :p] @ dz
    # Without the damping, which only limits the step: the ratio to the actual fall then measures the model itself.
    quadratic = dz @ (zz + prior) @ dz + 2 * np.einsum("wkp,wk,p->", b.sz, ds, dz)
    quadratic += np.einsum("wkl,wk,wl->", b.ss, ds, ds)
    return dz, ds, float(-(slope @ dz + np.sum(b.s * ds) + quadratic / 2))


def _ridge(matrices: Any) -> NumpyArray:
    """A small multiple of the identity for each matrix (B, k, k), for blocks in which too little is measured."""
    largest = np.max(np.diagonal(matrices, axis1=1, axis2=2), axis=1, initial=0.0) + 1e-300
    # Far above the rounding errors of the elimination, far below what one measurement tells.
    return 1e-12 * largest[:, None, None] * np.eye(matrices.shape[1])


def _span(projection: NumpyArray) -> Float[NumpyArray, "p d"]:
    """Orthonormal basis (p, d) of the image of a projection, whose eigenvalues are 0 and 1 but for rounding."""
    values, vectors = np.linalg.eigh(projection)
    return vectors[:, values > 0.5]


def reduced_rows(matrix: Float[NumpyArray, "r p"], least: float) -> tuple[NumpyArray, NumpyArray, NumpyArray]:
    """Leading columns (d,), other columns (p − d,), and rows (d, p − d) of the others in the reduced echelon form.

    By pivoted QR (Gautier 1991, Numerical calculation of the base inertial parameters of robots, Journal of Robotic
    Systems 8(4)); d is the number of pivots above `least`.
    """
    from scipy.linalg import qr

    _, r, order = qr(matrix, mode="economic", pivoting=True)  # pyright: ignore[reportAssignmentType]
    rank = int(np.sum(np.abs(np.diagonal(r)) > least))
    return order[:rank], order[rank:], np.linalg.solve(r[:rank, :rank], r[:rank, rank:])


def combination_rows(fixed: NumpyArray, ratio: NumpyArray) -> Float[NumpyArray, "d p"]:
    """Undetermined combinations as rows of changes, in other units by `ratio` (p,), reduced to few entries."""
    rows = _span(fixed).T * ratio
    if not len(rows):
        return rows
    leading, others, factors = reduced_rows(rows, 0.0)
    reduced = np.zeros((len(leading), rows.shape[1]))
    reduced[:, leading], reduced[:, others] = np.eye(len(leading)), factors
    reduced[np.abs(reduced) < SMALL] = 0.0
    return reduced
