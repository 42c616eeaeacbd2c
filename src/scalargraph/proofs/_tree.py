"""Stores the boxes of branch and bound as a binary tree, in which a box is halved, its halves are halved, and so on."""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from scalargraph.errors import InputError
from scalargraph.proofs._box import Box

CHUNK = 2048
"""Number of boxes evaluated at once; their intermediate values fit in the cache."""
PROVED, OPEN = -1, -2
"""Codes of leaves: the statement is proved on the whole box, or undecided."""


def leaves(domain: Box, levels: list[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The leaves of a tree of boxes, level by level.

    Args:
        domain: The whole box, of d variables.
        levels: One array of integers for each level, as in `Proof.levels`.

    Yields:
        For each level the codes (m,) of its leaves, `PROVED` or `OPEN`, and their corners low (m, d) and high (m, d).

    Raises:
        ValueError: The levels are not a tree over the domain.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs import OPEN, PROVED, box, leaves
        >>> levels = [np.array([0]), np.array([PROVED, OPEN])]
        >>> [low.tolist() for codes, low, high in leaves(box(a=(0.0, 1.0)), levels) if len(codes)]
        [[[0.0], [0.5]]]
    """
    low, high = domain.low[None], domain.high[None]
    for codes in itertools.chain(levels, [np.zeros(0, int)]):
        if len(codes) != len(low):
            raise InputError(f"a level of the tree of boxes must hold {len(low)} boxes; it holds {len(codes)}")
        end = codes < 0
        yield codes[end], low[end], high[end]
        low, high = halves(low[~end], high[~end], codes[~end])


def open_boxes(domain: Box, levels: list[np.ndarray]) -> Float[np.ndarray, "k 2 d"]:
    """Corners of the leaves that are not decided."""
    return np.concatenate([np.stack([low, high], 1)[codes == OPEN] for codes, low, high in leaves(domain, levels)])


def halves(low, high, axes) -> tuple[np.ndarray, np.ndarray]:
    """Both halves of boxes, the lower one first. Both include the middle, so that no point is lost."""
    rows = np.arange(len(low))
    middle = middle_of(low[rows, axes], high[rows, axes])
    low, high = np.repeat(low, 2, axis=0), np.repeat(high, 2, axis=0)
    high[2 * rows, axes] = middle
    low[2 * rows + 1, axes] = middle
    return low, high


def middle_of(low, high):
    """The midpoint, without overflow."""
    # low + high may overflow although low/2 + high/2 does not.
    return low / 2 + high / 2


class Tree:
    """Binary tree of boxes during branch and bound, in arrays: the code of each box, and its children.

    Attributes:
        domain: The whole box, of d variables.
        code: Code of each box: the variable that is halved, `PROVED`, or `OPEN`, which also marks a box not yet
            evaluated.
        child: Number of the lower half of each box that is halved; the upper half follows it.
        count: Number of boxes in use; the arrays are longer.
        evaluated: Number of boxes evaluated.
        decided: Fraction of the domain that is proved.
        waiting: Lots of boxes to evaluate: numbers, low, high and depths.

    Example:
        >>> import numpy as np
        >>> from scalargraph.proofs import PROVED, box
        >>> from scalargraph.proofs._tree import Tree
        >>> tree = Tree(box(a=(0.0, 1.0)))
        >>> tree.take(tree.next(), np.array([0]))  # halved
        >>> tree.take(tree.next(), np.array([PROVED, PROVED]))
        >>> tree.evaluated, tree.decided, tree.next() is None
        (3, 1.0, True)
    """

    def __init__(self, domain: Box):
        self.domain = domain
        self.code = np.full(1, OPEN)
        self.child = np.zeros(1, int)
        self.count, self.evaluated, self.decided = 1, 0, 0.0
        self.waiting: list[tuple[np.ndarray, ...]] = [
            (np.zeros(1, int), domain.low[None], domain.high[None], np.zeros(1, int))
        ]

    def next(self) -> tuple | None:
        """The next boxes to evaluate, at most `CHUNK`; small lots are combined."""
        if not self.waiting:
            return None
        lots, count = [], 0
        while self.waiting and count < CHUNK:
            # The latest boxes come first: this depth-first order keeps the number of waiting boxes small.
            lots.append(self.waiting.pop())
            count += len(lots[-1][0])
        whole = tuple(np.concatenate(part) for part in zip(*lots, strict=True))
        if count > CHUNK:
            self.waiting.append(tuple(part[CHUNK:] for part in whole))
        return tuple(part[:CHUNK] for part in whole)

    def take(self, lot: tuple, codes: Int[np.ndarray, "B"]) -> None:
        """Store the codes of a lot of boxes, and add the halves of those that are halved."""
        numbers, low, high, depth = lot
        self.evaluated += len(numbers)
        # A box at depth k has 2^−k of the volume of the domain.
        self.decided += float((2.0 ** -depth[codes == PROVED]).sum())
        split = codes >= 0
        new = 2 * int(split.sum())
        first = self.count
        self.count += new
        # The arrays are doubled, so that n boxes cost O(n) copies in all.
        while self.count > len(self.code):
            self.code = np.concatenate([self.code, np.full(len(self.code), OPEN)])
            self.child = np.concatenate([self.child, np.zeros(len(self.child), int)])
        self.code[numbers] = codes
        self.child[numbers[split]] = np.arange(first, first + new, 2)
        if new:
            children = halves(low[split], high[split], codes[split])
            self.waiting.append((np.arange(first, first + new), *children, np.repeat(depth[split] + 1, 2)))

    def levels(self) -> tuple[list[np.ndarray], Float[np.ndarray, "k 2 d"]]:
        """The tree, level by level, and its open boxes."""
        by_level, numbers = [], np.zeros(1, int)
        while len(numbers):
            by_level.append(self.code[numbers])
            split = numbers[self.code[numbers] >= 0]
            numbers = (self.child[split][:, None] + np.arange(2)).ravel()
        return by_level, open_boxes(self.domain, by_level)
