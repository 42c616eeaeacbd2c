"""Operations on intervals as steps of a tape: each works on bounds that are kept at numbered places.

An operation, a `kernel`, is a formula in NumPy that works box by box. Called on arrays it computes; called on places of
a tape it becomes a step of it. The bounds of a graph are then a list of steps, in the order and with the choices of
operations that NumPy makes, for whoever can do these steps faster.
"""

import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np


class Interval(NamedTuple):
    """Real numbers between two bounds, for each box: arrays of shape (B,), or scalars where all boxes share them."""

    low: Any
    high: Any


class Truth(NamedTuple):
    """What is known of a statement, for each box (B,): `must` if it holds everywhere on it, `may` if it may hold."""

    must: Any
    may: Any


class Kernel(NamedTuple):
    """A formula that works box by box on intervals, statements, and lists of numbers that all boxes share.

    - `arguments`: the kind of each argument: `Interval`, `Truth`, or the length of a list of numbers.
    - `result`: `Interval` or `Truth`.
    """

    formula: Callable[..., Any]
    arguments: tuple[type | int, ...]
    result: type

    @property
    def widths(self) -> list[int]:
        """How many places each argument has."""
        return [kind if isinstance(kind, int) else 2 for kind in self.arguments]


KERNELS: dict[str, Kernel] = {}
"""All kernels by name."""


class Place:
    """A place of a tape that holds one number or truth value for each box."""

    __slots__ = ("number", "tape")
    ndim = 1

    def __init__(self, tape: "Tape", number: int):
        self.tape, self.number = tape, number


class Step(NamedTuple):
    """A kernel with the places of its two results and of its arguments."""

    kernel: str
    results: tuple[int, int]
    arguments: tuple[int, ...]


class Tape:
    """Steps on places; `constants` are places that hold one number for all boxes."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.constants: dict[bytes, int] = {}
        self.count = 0

    def place(self) -> Place:
        """A new place."""
        self.count += 1
        return Place(self, self.count - 1)

    def number_of(self, value: Any) -> int:
        """The place of a value, which is one already or a number that all boxes share."""
        if type(value) is Place:
            return value.number
        bits = np.float64(value).tobytes()
        if bits not in self.constants:
            self.constants[bits] = self.place().number
        return self.constants[bits]

    def step(self, name: str, arguments: Sequence[Any]) -> Any:
        """The results of a kernel, as places."""
        read = tuple(self.number_of(end) for ends in arguments for end in ends)
        made = self.place(), self.place()
        self.steps.append(Step(name, (made[0].number, made[1].number), read))
        return KERNELS[name].result(*made)


def as_kernel(name: str, kernel: Kernel, compute: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel under a name: on arrays `compute`, which gives the values of its formula, and on places a step."""
    KERNELS[name] = kernel

    def apply(*arguments: Any) -> Any:
        for ends in arguments:
            for end in ends:
                if type(end) is Place:
                    return end.tape.step(name, arguments)
        return compute(*arguments)

    return apply


def kernel(formula: Callable[..., Any]) -> Callable[..., Any]:
    """A formula as a kernel of its own name; the kinds of its arguments are those it is declared with."""
    kinds = inspect.get_annotations(formula)
    result = kinds.pop("return")
    return as_kernel(formula.__name__, Kernel(formula, tuple(kinds.values()), result), formula)
