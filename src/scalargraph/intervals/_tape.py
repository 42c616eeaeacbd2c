"""Records interval operations as steps of a tape: each step reads and writes bounds at numbered places of the tape.

A `kernel` is an operation written as a NumPy formula that works box by box. Called on arrays, it computes. Called on
places of a tape, it appends a step to the tape. In this way the bounds of a graph become a list of steps, with the same
operations in the same order as in NumPy, which a faster engine can carry out.
"""

import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np


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


class Kernel(NamedTuple):
    """A formula that works box by box on intervals, statements, and lists of numbers that all boxes share.

    Attributes:
        formula: The function, on arrays (B,) or on symbols that stand for them.
        arguments: Kind of each argument: `Interval`, `Truth`, or the length of a list of numbers.
        result: `Interval` or `Truth`.
    """

    formula: Callable[..., Any]
    arguments: tuple[type | int, ...]
    result: type

    @property
    def widths(self) -> list[int]:
        """Number of places of each argument."""
        return [kind if isinstance(kind, int) else 2 for kind in self.arguments]


KERNELS: dict[str, Kernel] = {}
"""All kernels by name."""


class Place:
    """A place of a tape that holds one number or truth value for each box.

    Args:
        tape: The tape.
        number: Index of the place on it.
    """

    __slots__ = ("number", "tape")
    ndim = 1

    def __init__(self, tape: "Tape", number: int):
        self.tape, self.number = tape, number


class Step(NamedTuple):
    """A kernel applied to places of a tape.

    Attributes:
        kernel: Name of the kernel.
        results: Places of the lower and the upper bound of its result.
        arguments: Places of its arguments, one after the other.
    """

    kernel: str
    results: tuple[int, int]
    arguments: tuple[int, ...]


class Tape:
    """A list of steps on places.

    Attributes:
        steps: The steps, in order.
        constants: Places that hold one number for all boxes, by the bits of this number.
        count: Number of places in use.
    """

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.constants: dict[bytes, int] = {}
        self.count = 0

    def place(self) -> Place:
        """A new place."""
        self.count += 1
        return Place(self, self.count - 1)

    def number_of(self, value: Any) -> int:
        """Return the place of a value; a number is added as a constant if it is new."""
        if type(value) is Place:
            return value.number
        # Compared by bits, so that 0.0 and −0.0 stay distinct and NaN equals itself.
        bits = np.float64(value).tobytes()
        if bits not in self.constants:
            self.constants[bits] = self.place().number
        return self.constants[bits]

    def step(self, name: str, arguments: Sequence[Any]) -> Any:
        """Append a step."""
        argument_places = tuple(self.number_of(end) for ends in arguments for end in ends)
        bounds = self.place(), self.place()
        self.steps.append(Step(name, (bounds[0].number, bounds[1].number), argument_places))
        return KERNELS[name].result(*bounds)


def as_kernel(name: str, kernel: Kernel, compute: Callable[..., Any]) -> Callable[..., Any]:
    """Register a kernel, and return a function that computes on arrays and records a step on places."""
    KERNELS[name] = kernel

    def apply(*arguments: Any) -> Any:
        for ends in arguments:
            for end in ends:
                if type(end) is Place:
                    return end.tape.step(name, arguments)
        return compute(*arguments)

    return apply


def kernel(formula: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator that registers a formula as a kernel under the name of the function."""
    kinds = inspect.get_annotations(formula)
    result = kinds.pop("return")
    return as_kernel(formula.__name__, Kernel(formula, tuple(kinds.values()), result), formula)
