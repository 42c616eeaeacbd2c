"""Leaves of a saved tree of boxes, computed by the checker."""

import string
from collections.abc import Sequence

import numpy as np


def halves(low: np.ndarray, high: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both halves of boxes (B, d), lower before upper, along one axis each. Both include the middle."""
    rows = np.arange(len(low))
    middle = low[rows, axes] / 2 + high[rows, axes] / 2
    low, high = np.repeat(low, 2, 0), np.repeat(high, 2, 0)
    high[2 * rows, axes] = low[2 * rows + 1, axes] = middle
    return low, high


def leaves(low: np.ndarray, high: np.ndarray, levels: Sequence[str], what: str) -> tuple[np.ndarray, np.ndarray]:
    """The leaves of a tree, which cover its box (d,): both halves of every halved box are present.

    `levels`: one string for each level, with a letter for each box: that of the variable that is halved, or a dot for a
    leaf. Raises `ValueError` naming the tree, `what`, where it does not cover the box.
    """
    lows, highs, found = low[None], high[None], []
    for depth, level in enumerate(levels):
        axes = np.array([(string.ascii_letters[: len(low)] + ".").find(letter) for letter in level], int)
        fits = len(axes) == len(lows) and (axes >= 0).all()
        if not fits:
            raise ValueError(f"level {depth} of {what} must have {len(lows)} letters or dots; it is {level[:60]!r}")
        end = axes == len(low)
        found.append((lows[end], highs[end]))
        lows, highs = halves(lows[~end], highs[~end], axes[~end])
    if len(lows):
        raise ValueError(f"{what} lacks the last {len(lows)} boxes")
    first, second = zip(*found, strict=True)
    return np.concatenate(first), np.concatenate(second)
