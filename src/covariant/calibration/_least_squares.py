"""Robust nonlinear least squares by blocks: weights, solver, covariance, and what the data do not determine.

Errors come in blocks of rows of a log: within a block they may be alike, between blocks they are independent.

Source: Marquardt 1963, and Madsen, Nielsen & Tingleff 2004, section 3.2, for steps; Huber 1981, Robust Statistics,
sections 6.3 and 7.6, for weights and covariance; White 1982 for the covariance from blocks.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

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
    """The loss of each block and its derivatives in p unknowns z, and what else the errors are needed for.

    `zz` majorises the second derivatives, and is used for steps; `informations` are those of the loss itself.
    """

    loss: Float[NumpyArray, "B"]
    z: Float[NumpyArray, "B p"]
    zz: Float[NumpyArray, "p p"]
    informations: Float[NumpyArray, "B p p"]
    rest: Any = None

    @property
    def information(self) -> Float[NumpyArray, "p p"]:
        """Second derivatives (p, p) of the whole loss."""
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


class Residuals(Protocol):
    """What a search minimises."""

    def blocks(self, z: NumpyArray, kept: Any = None) -> Blocks:
        """The loss and its derivatives at z (p,); `kept` is the `rest` of the last accepted point."""
        ...

    def moved(self, z: NumpyArray, dz: NumpyArray) -> NumpyArray:
        """Unknowns (p,) after a step dz from z."""
        ...

    def lowest(self, z: NumpyArray) -> NumpyArray:
        """Least steps (p,) from z that bounds permit; minus infinity for unknowns without one."""
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
    """A point of a search: z (p,), and the loss with its derivatives there."""

    z: Float[NumpyArray, "p"]
    blocks: Blocks

    @classmethod
    def at(cls, residuals: Residuals, z: NumpyArray, kept: Any = None) -> "Point":
        return cls(z, residuals.blocks(z, kept))

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
) -> Point:
    """Minimise the loss from a point by Levenberg–Marquardt steps; returns the last point."""
    # Relative to the diagonal: the first step is nearly the full one of Gauss and Newton (Madsen et al., 3.2).
    damping, growth = 1e-3, 2.0
    for k in range(most):
        progress(k)
        dz, promised = _step(point, fixed, damping, residuals.lowest(point.z))
        if promised < TOLERANCE:
            return point
        tried = Point.at(residuals, residuals.moved(point.z, dz), point.blocks.rest)
        gain = (point.loss(fixed) - tried.loss(fixed)) / promised
        if gain > 0:  # False where the trial is not finite
            point, growth = tried, 2.0
            # Nielsen's rule: the better the prediction of the fall was, the smaller the damping (Madsen et al., 3.2).
            damping *= max(1 / 10, 1 - (2 * min(gain, 1.0) - 1) ** 3)
        else:
            damping, growth = damping * growth, 2 * growth
    return point


def _step(point: Point, fixed: Fixed, damping: float, lowest: NumpyArray) -> tuple[NumpyArray, float]:
    """A damped Gauss–Newton step above its bounds, and the predicted fall of the loss."""
    zz, p = point.blocks.zz, len(point.z)
    fixing = FIXING**2 * fixed.directions
    prior = np.eye(p) / PRIOR**2 + fixing
    damped = zz + damping * np.diag(np.diagonal(zz)) + prior
    slope = np.sum(point.blocks.z, axis=0) + prior @ point.z - fixing @ fixed.at
    size = np.sqrt(np.diagonal(damped))
    # Scaled to a unit diagonal, since the sensitivities differ by orders of magnitude.
    dz = minimise_above_bounds(damped / np.outer(size, size), slope / size, lowest * size) / size
    # Without the damping, which only limits the step: the ratio to the actual fall then measures the model itself.
    return dz, float(-(slope @ dz + dz @ (zz + prior) @ dz / 2))


def minimise_above_bounds(matrix: np.ndarray, gradient: np.ndarray, least: np.ndarray) -> np.ndarray:
    """The step that minimises a quadratic function above bounds."""
    from scipy.optimize import lsq_linear

    step = -np.linalg.solve(matrix, gradient)
    if not (step < least - 1e-12).any():  # nor where it is not finite, which whoever searches refuses
        return step
    root = np.linalg.cholesky(matrix)
    return lsq_linear(root.T, -np.linalg.solve(root, gradient), (least, np.inf), method="bvls").x


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
