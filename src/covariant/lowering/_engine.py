"""Bounds of a graph over boxes, by NumPy or by compiled C, whichever is done sooner; both give the same."""

import functools
import weakref
from typing import Literal

import numpy as np

from covariant.lowering._c_intervals import CompiledBounds, Library, at_hand
from covariant.lowering._enclose import Enclosure, by_numpy, corners
from covariant.lowering._graph import Graph
from covariant.lowering._lowered import Lowered

Engine = Literal["auto", "numpy", "c"]
A_CALL = 1500
"""What a call costs NumPy beside the boxes it is for, in boxes. To write a graph down for C costs as much."""
COMPILATION = 2e8
"""What the compilation costs, in boxes times nodes by NumPy."""


class _Work:
    """What was done for a graph: by NumPy, in boxes; and the graph for C, where it has been written down."""

    def __init__(self) -> None:
        self.boxes = 0
        self.compiled: CompiledBounds | None = None


_DONE: weakref.WeakKeyDictionary[Graph, dict[tuple[int, ...], _Work]] = weakref.WeakKeyDictionary()
_effort = 0.0


def enclose(lowered: Lowered, low: np.ndarray, high: np.ndarray, engine: Engine = "auto") -> Enclosure:
    """Bounds on the values of a graph over boxes with corners `low` and `high`, both (B, inputs).

    - `engine`: NumPy begins; compiled C goes on with a graph that is used again, once it is compiled or so much has been
      done that the compilation pays. "numpy" and "c" leave no choice. The bounds are the same, but for the sign of zeros.

    Statements among the outputs are bounded as the numbers 0 and 1. Raises `ValueError` for corners of another shape,
    that are not numbers, or where low exceeds high; `OSError` for the engine "c" where there is none.
    """
    low, high = corners(low, high, lowered.inputs)
    if not len(low):
        nothing = np.empty((0, len(lowered.outputs)))
        return Enclosure(nothing, nothing, np.ones(0, bool))
    if engine == "numpy":
        return by_numpy(lowered, low, high)
    work = _DONE.setdefault(lowered.graph, {}).setdefault(lowered.outputs, _Work())
    if work.compiled is None and (engine == "c" or _pays(work)):
        made = _library()
        if isinstance(made, Library):
            work.compiled = CompiledBounds(lowered, made)
        elif engine == "c":
            raise OSError(made)
    return work.compiled(low, high) if work.compiled is not None else _counted(work, lowered, low, high)


def _pays(work: _Work) -> bool:
    return work.boxes >= 2 * A_CALL and (_at_hand() or _effort >= COMPILATION)


def _counted(work: _Work, lowered: Lowered, low: np.ndarray, high: np.ndarray) -> Enclosure:
    global _effort
    work.boxes += len(low) + A_CALL
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
