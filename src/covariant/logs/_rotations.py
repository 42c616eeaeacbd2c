"""Converts rotations between columns of a log and matrices, for whole columns at once in NumPy."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

TOLERANCE = 0.05
"""Largest deviation from 1 of a quaternion's length, or of a matrix's singular value, that counts as rounding."""

Cells = Float[np.ndarray, "T k"]
Rotations = Float[np.ndarray, "T d d"]


class Kind(NamedTuple):
    """A representation of rotations.

    Attributes:
        matrices: Converts cells (T, k) to the nearest rotation matrices (T, d, d).
        fault: Mask (T,) of the rows that are invalid, and a function that describes the fault of a row.
        cells: Converts rotation matrices (T, d, d) to cells (T, k).
    """

    matrices: Callable[[Cells], Rotations]
    fault: Callable[[Cells], tuple[np.ndarray, Callable[[int], str]]]
    cells: Callable[[Rotations], Cells]


def _from_wxyz(q: Cells) -> Rotations:
    # Logs have few digits, so the length of a quaternion is 1 only up to their rounding.
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)


def _to_wxyz(r: Rotations) -> Cells:
    """The quaternions of a motion, without jumps between q and −q; the first one has w ≥ 0."""
    # Each row of the table is 4 qᵢ q for an entry qᵢ; the longest row is the most accurate. Source: Shepperd 1978.
    x, y, z = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    # For a unit quaternion r₂₁ − r₁₂ = 4wx and r₂₁ + r₁₂ = 4yz, and likewise for cyclic permutations.
    a, b, c = (r[:, i, j] - r[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (r[:, i, j] + r[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    rows = ((1 + x + y + z, a, b, c), (a, 1 + x - y - z, f, e), (b, f, 1 - x + y - z, d), (c, e, d, 1 - x - y + z))
    table = np.moveaxis(np.array(rows), 2, 0)
    longest = table[np.arange(len(r)), np.argmax(np.einsum("kii->ki", table), axis=1)]
    q = longest / np.linalg.norm(longest, axis=1, keepdims=True)
    # q and −q are the same rotation. A negative product with the previous row is a jump of sign, reversed from there.
    products = np.concatenate([q[:1, 0], np.einsum("ki,ki->k", q[1:], q[:-1])])
    return q * np.cumprod(np.where(products < 0, -1.0, 1.0))[:, None]


def _length_fault(q: Cells) -> tuple[np.ndarray, Callable[[int], str]]:
    length = np.linalg.norm(q, axis=1)

    def words(k: int) -> str:
        return f"the quaternion has length {length[k]:.3g}, needs 1; normalise it"

    return np.abs(length - 1) > TOLERANCE, words


def _shape_fault(cells: Cells) -> tuple[np.ndarray, Callable[[int], str]]:
    matrix = cells.reshape(-1, 3, 3)
    stretch, determinant = np.linalg.svd(matrix, compute_uv=False), np.linalg.det(matrix)
    off = np.abs(stretch - 1).max(axis=1)

    def words(k: int) -> str:
        if off[k] > TOLERANCE:
            worst = stretch[k, np.abs(stretch[k] - 1).argmax()]
            return f"the matrix is not orthogonal, it stretches {worst:.3g} times; check the order of its columns"
        size = f"its determinant is {determinant[k]:.3g}"
        return f"the matrix is a reflection, {size}: swap or negate one left-handed axis"

    return (off > TOLERANCE) | (determinant < 0), words


def _nearest(cells: Cells) -> Rotations:
    # U Vᵀ of the singular value decomposition is the nearest orthogonal matrix; reflections were refused before.
    left, _, right = np.linalg.svd(cells.reshape(-1, 3, 3))
    return left @ right


def _from_angle(cells: Cells) -> Rotations:
    c, s = np.cos(cells[:, 0]), np.sin(cells[:, 0])
    return np.moveaxis(np.array(((c, -s), (s, c))), 2, 0)


def _to_angle(r: Rotations) -> Cells:
    return np.unwrap(np.arctan2(r[:, 1, 0], r[:, 0, 0]))[:, None]


def _no_fault(cells: Cells) -> tuple[np.ndarray, Callable[[int], str]]:
    return np.zeros(len(cells), bool), lambda k: ""


_LAST_FIRST, _FIRST_LAST = [3, 0, 1, 2], [1, 2, 3, 0]

KINDS = {
    "quaternion_wxyz": Kind(_from_wxyz, _length_fault, _to_wxyz),
    "quaternion_xyzw": Kind(
        lambda q: _from_wxyz(q[:, _LAST_FIRST]), _length_fault, lambda r: _to_wxyz(r)[:, _FIRST_LAST]
    ),
    "matrix": Kind(_nearest, _shape_fault, lambda r: r.reshape(-1, 9)),
    "angle": Kind(_from_angle, _no_fault, _to_angle),
}
"""The representations by name; "angle" [rad] is for rotations in the plane, the others for rotations in space."""
