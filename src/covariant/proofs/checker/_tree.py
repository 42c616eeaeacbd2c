"""Leaves of a saved tree of boxes, computed by the checker."""

import string
from collections.abc import Sequence

import numpy as np


def halves(low: np.ndarray, high: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both halves of boxes, lower before upper, along one axis each. Both include the middle, so that
    no point is lost.
    """
    rows = np.arange(len(low))
    # Rounded, but the same number in both halves, so that together they still cover the box.
    middle = low[rows, axes] / 2 + high[rows, axes] / 2
    low, high = np.repeat(low, 2, 0), np.repeat(high, 2, 0)
    high[2 * rows, axes] = low[2 * rows + 1, axes] = middle
    return low, high


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
        ValueError: The tree does not cover the box, or has another character, such as that of an open leaf.

    Example:
        >>> import numpy as np
        >>> from covariant.proofs.checker import leaves
        >>> low, high = leaves(np.zeros(1), np.ones(1), ["a", ".."], "claim 1")
        >>> low.tolist(), high.tolist()
        ([[0.0], [0.5]], [[0.5], [1.0]])
    """
    lows, highs, parts = low[None], high[None], []
    for depth, level in enumerate(levels):
        axes = np.array([(string.ascii_letters[: len(low)] + ".").find(letter) for letter in level], int)
        fits = len(axes) == len(lows) and (axes >= 0).all()
        if not fits:
            raise ValueError(f"level {depth} of {what} must have {len(lows)} letters or dots; it is {level[:60]!r}")
        end = axes == len(low)
        parts.append((lows[end], highs[end]))
        lows, highs = halves(lows[~end], highs[~end], axes[~end])
    if len(lows):
        raise ValueError(f"{what} lacks the last {len(lows)} boxes")
    first, second = zip(*parts, strict=True)
    return np.concatenate(first), np.concatenate(second)
