"""Types of the arithmetic of intervals: numbers and statements, each known on every box of a batch."""

from typing import Any, NamedTuple


class Interval(NamedTuple):
    """Real numbers between two bounds, for each box of a batch.

    It is the number type of the arithmetic `INTERVALS`. Bounds are rounded outwards, so that the exact result always
    lies between them. Work on a batch of boxes at once: the time of a single box is mostly overhead.

    Attributes:
        low: Lower bound (B,), or a scalar that all boxes share; NaN if nothing is known.
        high: Upper bound, of the same shape.

    Example:
        >>> import numpy as np
        >>> import scalargraph
        >>> from scalargraph.intervals import INTERVALS
        >>> a = scalargraph.Interval(np.array([1.0]), np.array([2.0]))
        >>> b = INTERVALS["neg"](a)
        >>> b.low.tolist(), b.high.tolist()
        ([-2.0], [-1.0])
    """

    low: Any
    high: Any


class Truth(NamedTuple):
    """Truth of a statement on each box of a batch, as far as bounds decide it.

    Attributes:
        must: Whether it is proved to hold everywhere on the box (B,).
        may: Whether it may hold somewhere on the box (B,). If it may but need not hold, the statement is undecided.

    Example:
        >>> import numpy as np
        >>> import scalargraph
        >>> from scalargraph.intervals import INTERVALS
        >>> a = scalargraph.Interval(np.array([0.0, 0.0]), np.array([1.0, 3.0]))
        >>> b = scalargraph.Interval(np.array([2.0, 2.0]), np.array([4.0, 4.0]))
        >>> less = INTERVALS["lt"](a, b)  # proved for the first box, undecided for the second
        >>> less.must.tolist(), less.may.tolist()
        ([True, False], [True, True])
    """

    must: Any
    may: Any
