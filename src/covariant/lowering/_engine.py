"""Bounds of a graph over boxes, by NumPy or by compiled C, whichever is done sooner; both give the same."""

import functools
import weakref

import numpy as np

from covariant._typing import Arithmetic
from covariant.lowering._c_intervals import CompiledBounds, Library, at_hand
from covariant.lowering._enclose import Enclosure, by_numpy, corners
from covariant.lowering._graph import Graph
from covariant.lowering._lowered import Lowered

A_CALL = 1500
"""What a call costs NumPy beside the boxes it is for, in boxes. To write the graph down for C costs less."""
COMPILATION = 2e8
"""What the compilation costs, in boxes times nodes by NumPy."""


_WRITTEN: weakref.WeakKeyDictionary[Graph, dict[tuple[int, ...], CompiledBounds]] = weakref.WeakKeyDictionary()
_effort = 0.0


def enclose(lowered: Lowered, low: np.ndarray, high: np.ndarray, engine: Arithmetic = "auto") -> Enclosure:
    """Bounds on the values of a graph over boxes with corners `low` and `high`, both (B, inputs).

    - `engine`: "auto" is compiled C where it was compiled before, or so much has been done by NumPy that compiling it
      pays; "numpy" and "c" leave no choice. The bounds are the same, but for the sign of zeros.

    Statements among the outputs are bounded as the numbers 0 and 1. Raises `ValueError` for corners of another shape,
    that are not numbers, or where low exceeds high; `OSError` for the engine "c" where there is none.
    """
    low, high = corners(low, high, lowered.inputs)
    if not len(low):
        nothing = np.empty((0, len(lowered.outputs)))
        return Enclosure(nothing, nothing, np.ones(0, bool))
    if engine == "numpy":
        return by_numpy(lowered, low, high)
    written = _WRITTEN.setdefault(lowered.graph, {})
    if lowered.outputs not in written:
        made = _library() if in_c(engine) else ""
        if not isinstance(made, Library):
            if engine == "c":
                raise OSError(made)
            return _counted(lowered, low, high)
        written[lowered.outputs] = CompiledBounds(lowered, made)
    return written[lowered.outputs](low, high)


def in_c(engine: Arithmetic) -> bool:
    """Whether compiled C is to do the work from now on, if there is a compiler."""
    return engine == "c" or (engine == "auto" and (_at_hand() or _effort >= COMPILATION))


def _counted(lowered: Lowered, low: np.ndarray, high: np.ndarray) -> Enclosure:
    global _effort
    _effort += (len(low) + A_CALL) * len(lowered.graph.nodes)
    return by_numpy(lowered, low, high)


@functools.cache
def _library() -> Library | str:
    """The compiled kernels, or why there are none."""
    try:
        return Library()
    except OSError as error:
        return str(error)


@functools.cache
def _at_hand() -> bool:
    return at_hand()
