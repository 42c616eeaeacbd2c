"""Bounds a graph over boxes by NumPy or by compiled C, whichever takes less time; both give the same bounds."""

import functools
import weakref
from typing import Literal

import numpy as np

from scalargraph.graph import Graph, Lowered
from scalargraph.intervals._c_intervals import CompiledBounds, Library, at_hand
from scalargraph.intervals._enclose import Enclosure, by_numpy, corners

Arithmetic = Literal["auto", "numpy", "c"]
"""Implementation of interval arithmetic: NumPy, compiled C, or "auto" for C as soon as compiling it saves time."""

A_CALL = 1500
"""Fixed cost of a call of NumPy, expressed in boxes. Translating the graph into steps for C costs less."""
COMPILATION = 2e8
"""Cost of the compilation, expressed as boxes times nodes evaluated by NumPy."""


# The keys are weak references, so that the steps of a graph are released with it.
_WRITTEN: weakref.WeakKeyDictionary[Graph, dict[tuple[int, ...], CompiledBounds]] = weakref.WeakKeyDictionary()
_effort = 0.0


def enclose(lowered: Lowered, low: np.ndarray, high: np.ndarray, engine: Arithmetic = "auto") -> Enclosure:
    """Bound the values of a function over boxes, rigorously.

    Use it to bound a function over a region with certainty, which samples cannot do. The bounds are safe but may be
    wide, since each occurrence of a variable counts as an independent variable: halve the boxes for tighter bounds.
    `proofs.prove` does this for matrices until a verdict is reached.

    Args:
        lowered: The function, without loops or tables.
        low: Lower corners of the boxes (B, inputs).
        high: Upper corners (B, inputs), low ≤ high.
        engine: "numpy", "c", or "auto": compiled C once it has been compiled, or once NumPy has done so much work that
            compiling pays. The bounds are the same, but for the sign of zeros.

    Returns:
        The bounds of each output over each box, rounding errors included. Statements are bounded as the numbers 0 and
        1.

    Raises:
        ValueError: The corners have another shape, are NaN, or low exceeds high; or the function has loops or tables.
        OSError: The engine is "c" and there is no working compiler.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> square = scalargraph.lower(lambda x: x * x, jnp.array(0.0))
        >>> bounds = scalargraph.enclose(square, np.array([[-1.0]]), np.array([[2.0]]), engine="numpy")
        >>> bounds.low.round(9).tolist(), bounds.high.round(9).tolist()
        ([[0.0]], [[4.0]])
    """
    low, high = corners(low, high, lowered.inputs)
    if not len(low):
        nothing = np.empty((0, len(lowered.outputs)))
        return Enclosure(nothing, nothing, np.ones(0, bool))
    if engine == "numpy":
        return by_numpy(lowered, low, high)
    written = _WRITTEN.setdefault(lowered.graph, {})
    if lowered.outputs not in written:
        library = _library() if in_c(engine) else ""
        if not isinstance(library, Library):
            if engine == "c":
                raise OSError(library)
            return _by_numpy(lowered, low, high)
        written[lowered.outputs] = CompiledBounds(lowered, library)
    return written[lowered.outputs](low, high)


def in_c(engine: Arithmetic) -> bool:
    """Whether compiled C is to do the interval arithmetic from now on, if there is a compiler.

    Args:
        engine: "c" always gives True and "numpy" False. "auto" gives True if the kernels have been compiled before, or
            if this process has done enough work by NumPy.

    Example:
        >>> from scalargraph.intervals import in_c
        >>> in_c("c"), in_c("numpy")
        (True, False)
    """
    return engine == "c" or (engine == "auto" and (_was_compiled() or _effort >= COMPILATION))


def _by_numpy(lowered: Lowered, low: np.ndarray, high: np.ndarray) -> Enclosure:
    global _effort
    _effort += (len(low) + A_CALL) * len(lowered.graph.nodes)
    return by_numpy(lowered, low, high)


@functools.cache
def _library() -> Library | str:
    """The compiled kernels, or the reason why there are none."""
    try:
        return Library()
    except OSError as error:
        return str(error)


@functools.cache
def _was_compiled() -> bool:
    return at_hand()
