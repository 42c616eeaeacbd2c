"""Tests on boxes whether a matrix is positive definite: the checker's test, by Taylor models, with rounding bounded."""

import itertools
import math
import time
from collections.abc import Iterable

import numpy as np

from scalargraph.errors import InputError
from scalargraph.proofs.checker._enclosure import TaylorEnclosure
from scalargraph.proofs.checker._taylor import ROUND, TINY, UndecidedError
from scalargraph.proofs.checker._tree import SavedTree, halves

CHUNK, MOST = 1024, 20_000
"""Number of boxes evaluated at once, and largest number of boxes that may be added to the list by halving."""
TURN = 0.1
"""Weight that each variable gets in addition to its share of the blame for open choices and remainders."""


def definite(
    matrix: np.ndarray, width: np.ndarray, kinks: np.ndarray, left: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return on which boxes a symmetric matrix is positive definite, and which variable to halve on the others.

    A matrix `Σ Sₘeₘ` with e₀ = 1 and all other |eₘ| ≤ 1 is positive definite if, for some C, the spectral radius of `E
    = |CᵀS₀C − I| + Σ|CᵀSₘC|` is below one, that is, if Ex < x for some positive x.
    """
    keys = sorted({m for entry in matrix.flat for part in entry.terms for m in part})
    s, radius = np.zeros((len(keys), len(width), *matrix.shape)), np.zeros((len(width), *matrix.shape))
    for (i, j), entry in np.ndenumerate(matrix):
        radius[:, i, j] = entry.radius
        for m, t in itertools.chain(*(part.items() for part in entry.terms)):
            s[keys.index(m), :, i, j] = t
    with np.errstate(all="ignore"):
        # C need not be exact, since E is computed for this very C; scaling to a unit diagonal keeps it well
        # conditioned.
        unit = 1 / np.sqrt(np.diagonal(s[0], axis1=1, axis2=2))[:, :, None]
        scaled = unit * s[0] * unit.swapaxes(1, 2)
        values, vectors = np.linalg.eigh(np.where(np.isfinite(scaled), scaled, -np.eye(len(matrix))))
        # C = U V |Λ|^−½ Vᵀ of the scaled middle. Many C turn it into the identity; this one rotates least, and
        # rotations add absolute values of terms. A negative eigenvalue becomes −1: then E is large, nothing is shown.
        c = unit * (vectors / np.sqrt(np.maximum(abs(values), TINY))[:, None]) @ vectors.swapaxes(1, 2)
        ct = c.swapaxes(1, 2)
        turned = ct @ s @ c
        turned[0] -= np.eye(len(matrix))
        # |Cᵀ| R |C| bounds the contribution of the radii, and the part with ROUND Σ|Sₘ| bounds the rounding of the
        # products CᵀSₘC.
        rest = abs(ct) @ (radius + ROUND * abs(s).sum(0)) @ abs(c)
        # ROUND covers the subtraction of the identity and the sums here, so E is an upper bound.
        e = abs(turned).sum(0) + rest + ROUND
        x = np.ones((*e.shape[:2], 1))
        for _ in range(5):
            x = e @ x
            # Any positive x proves the claim, so roundings of x do not matter; ROUND keeps all entries positive.
            x = x / x.max(1, keepdims=True) + ROUND
        # The left side is rounded up by more than the error of its sums. A comparison with NaN is false.
        good = (e @ x * (1 + ROUND) < x).all((1, 2))

    def by_variable(parts: Iterable[np.ndarray]) -> np.ndarray:
        """Sums of the contributions of terms, over all terms that contain each variable (B, d)."""
        named = list(zip(parts, keys, strict=True))
        return np.stack([sum((p for p, m in named if k in m), 0.0 * good) for k in range(width.shape[1])], 1)

    # Sums may overflow; weights that are not finite are replaced below.
    with np.errstate(all="ignore"):
        weight = by_variable(abs(t).sum((1, 2)) for t in turned)
        outweighed = ~(rest.sum((1, 2)) <= weight.sum(1))[:, None]
        # Halving a variable does not reduce this blame: some box, however small, contains the kink, and entries without
        # a bound have no size. Therefore the blame counts less the more often the variable was halved, so that other
        # variables are halved too. Remainders of high order, which belong to no variable, are treated in the same way.
        blame = np.where(kinks.any(1, keepdims=True), kinks, weight)
        share = blame / np.maximum(blame.sum(1, keepdims=True), TINY)
        weight = np.where(outweighed, (share + TURN) * np.sqrt(left), weight)
    # If some entries have no bound at all, the variables in their terms are halved.
    unbounded = by_variable(np.asarray(1.0 * ~np.isfinite(t).all((1, 2))) for t in s) * np.sqrt(left)
    weight = np.where(np.isfinite(weight).all(1, keepdims=True), weight, unbounded)
    known = np.isfinite(weight).all(1, keepdims=True) & (weight > 0).any(1, keepdims=True)
    return good, np.where(known, weight, width).argmax(1)


def show_definite(
    matrix: TaylorEnclosure, low: np.ndarray, high: np.ndarray, depth: int, what: str, until: float = math.inf
) -> None:
    """Show that `matrix + matrixᵀ` is positive definite on all boxes, which are halved if needed."""
    left, most, size = np.full(len(low), depth), len(low) + MOST, CHUNK
    whole = np.where(high > low, high - low, 1.0)
    while len(low):
        if time.monotonic() > until:
            raise TimeoutError(f"{what} is not settled yet")
        # The last boxes come first, with their halves: an operation on many boxes costs little more than on one.
        (low, a), (high, b), (left, deep), (whole, first) = ((x[:-size], x[-size:]) for x in (low, high, left, whole))
        if len(low) > most or (deep < 0).any():
            k = deep.argmin()
            box = ", ".join(f"{c:.6g} to {d:.6g}" for c, d in zip(a[k], b[k], strict=True))
            raise InputError(f"{what} is not shown to hold where the variables are {box}")
        try:
            enclosure = matrix(a, b)
            good, axes = definite(enclosure + enclosure.T, b - a, matrix.kinks(), (b - a) / first)
        except UndecidedError:
            good, axes = np.zeros(len(a), bool), (b - a).argmax(1)
            if len(a) > 1:
                # A branch must be the same on all boxes of a lot, which is likelier for fewer boxes.
                size = len(a) // 2
                pairs = (low, a), (high, b), (left, deep), (whole, first)
                low, high, left, whole = (np.concatenate(pair) for pair in pairs)
                continue
        size = min(2 * size, CHUNK)
        lower, upper = halves(a[~good], b[~good], axes[~good])
        low, high = np.concatenate([low, lower]), np.concatenate([high, upper])
        left = np.concatenate([left, np.repeat(deep[~good] - 1, 2)])
        whole = np.concatenate([whole, np.repeat(first[~good], 2, axis=0)])


def show_tree(
    matrix: TaylorEnclosure,
    tree: SavedTree,
    numbers: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    depth: int,
    what: str,
    until: float = math.inf,
) -> None:
    """Show that `matrix + matrixᵀ` is positive definite on boxes of a saved tree, from larger ones down to its leaves.

    If a box is shown, the boxes below it are skipped. The tree only suggests which boxes to try.
    """
    # Larger boxes would not fill a chunk, and an operation on few boxes takes as long as one on many.
    most = max(1, int(tree.leaves[numbers].sum()) // CHUNK)
    waiting, resisting = tree.boxes(numbers, low, high, most), []
    while most > 1 and len(waiting[0]):
        if time.monotonic() > until:
            raise TimeoutError(f"{what} is not settled yet")
        numbers, a, b = (part[-CHUNK:] for part in waiting)
        waiting = [part[:-CHUNK] for part in waiting]
        try:
            enclosure = matrix(a, b)
            good = definite(enclosure + enclosure.T, b - a, matrix.kinks(), np.ones_like(a))[0]
        except UndecidedError:  # a condition that is open here may be decided on smaller boxes
            good = np.zeros(len(a), bool)
        end = tree.leaves[numbers] == 1
        resisting.append((a[~good & end], b[~good & end]))
        below = tree.halved(*(part[~good & ~end] for part in (numbers, a, b)))
        waiting = [np.concatenate(pair) for pair in zip(waiting, below, strict=True)]
        large = 2 * tree.leaves[numbers] > most
        if 3 * np.count_nonzero(good & large) < np.count_nonzero(large):
            # Most boxes of this size fail, so the next ones have at most half as many leaves.
            most //= 2
            waiting = tree.boxes(*waiting, most)
    low, high = (np.concatenate(parts) for parts in zip(waiting[1:], *resisting, strict=True))
    show_definite(matrix, low, high, depth, what, until)
