"""Reads a saved tree of boxes for the checker: the boxes it contains, and the halves into which each is divided."""

import string
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scalargraph.errors import InputError

Boxes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Indices (m,) of boxes in a tree, with their lower and upper corners (m, d)."""


def halves(low: np.ndarray, high: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both halves of boxes, the lower one first, along one axis for each box. Both include the middle, so that
    no point is lost.
    """
    rows = np.arange(len(low))
    # The middle is rounded, but it is the same number in both halves, so that they still cover the box.
    middle = low[rows, axes] / 2 + high[rows, axes] / 2
    low, high = np.repeat(low, 2, 0), np.repeat(high, 2, 0)
    high[2 * rows, axes] = low[2 * rows + 1, axes] = middle
    return low, high


class SavedTree(NamedTuple):
    """The boxes of a saved tree, level by level; box number 0 is the whole box.

    Attributes:
        axes: Variable across which each box is halved (N,); −1 for a leaf.
        child: Number of the lower half of each box (N,); the upper half is the next one. It has no meaning for a leaf.
        leaves: Number of leaves in each box (N,).

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs.checker import SavedTree
        >>> tree = SavedTree.read(1, ["a", "a.", ".."], "claim 1")
        >>> tree.leaves.tolist()
        [3, 2, 1, 1, 1]
        >>> tree.boxes(np.zeros(1, int), np.zeros((1, 1)), np.ones((1, 1)), 2)[2].tolist()  # of two leaves at most
        [[0.5], [1.0]]
    """

    axes: np.ndarray
    child: np.ndarray
    leaves: np.ndarray

    @classmethod
    def read(cls, variables: int, levels: Sequence[str], what: str) -> "SavedTree":
        """Read a tree of boxes with this number of variables; `levels` and `what` as for `leaves`."""
        codes = np.full(256, -2)
        codes[[ord(letter) for letter in string.ascii_letters[:variables]]] = np.arange(variables)
        codes[ord(".")] = -1
        parts, size = [], 1
        for depth, level in enumerate(levels):
            axes = codes[np.frombuffer(level.encode("latin-1", "replace"), np.uint8)]
            if len(axes) != size or (axes < -1).any():
                raise InputError(f"level {depth} of {what} must have {size} letters or dots; it is {level[:60]!r}")
            parts.append(axes)
            size = 2 * np.count_nonzero(axes >= 0)
        if size:
            raise InputError(f"{what} lacks the last {size} boxes")
        axes = np.concatenate(parts)
        # Boxes are numbered level by level: the k-th box that is halved has the halves 2k − 1 and 2k.
        child = 2 * np.cumsum(axes >= 0) - 1
        count, stop = np.ones(len(axes), int), len(axes)
        for part in reversed(parts):
            inner = np.flatnonzero(part >= 0) + stop - len(part)
            count[inner] = count[child[inner]] + count[child[inner] + 1]
            stop -= len(part)
        return cls(axes, child, count)

    def halved(self, numbers: np.ndarray, low: np.ndarray, high: np.ndarray) -> Boxes:
        """Compute both halves of boxes that are not leaves."""
        both = (self.child[numbers][:, None] + np.arange(2)).ravel()
        return both, *halves(low, high, self.axes[numbers])

    def boxes(self, numbers: np.ndarray, low: np.ndarray, high: np.ndarray, most: int) -> Boxes:
        """Divide boxes into the largest boxes of the tree with at most `most` leaves."""
        parts, boxes = [], (numbers, low, high)
        while len(boxes[0]):
            small = self.leaves[boxes[0]] <= most
            parts.append([part[small] for part in boxes])
            boxes = self.halved(*(part[~small] for part in boxes))
        first, second, third = zip(*parts, strict=True) if parts else [(x,) for x in boxes]
        return np.concatenate(first), np.concatenate(second), np.concatenate(third)


def leaves(low: np.ndarray, high: np.ndarray, levels: Sequence[str], what: str) -> tuple[np.ndarray, np.ndarray]:
    """The leaves of a saved tree, which cover its box: both halves of every halved box are present.

    Args:
        low: Lower corner (d,) of the box.
        high: Upper corner (d,).
        levels: One string for each level, with a character for each box: the letter of the variable that is halved, or
            a dot for a leaf.
        what: Name of the tree, for the message.

    Returns:
        Lower and upper corners (m, d) of the m leaves.

    Raises:
        ValueError: The tree does not cover the box, or has an invalid character, such as the mark of an open leaf.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs.checker import leaves
        >>> low, high = leaves(np.zeros(1), np.ones(1), ["a", ".."], "claim 1")
        >>> low.tolist(), high.tolist()
        ([[0.0], [0.5]], [[0.5], [1.0]])
    """
    tree = SavedTree.read(len(low), levels, what)
    return tree.boxes(np.zeros(1, int), low[None], high[None], 1)[1:]
