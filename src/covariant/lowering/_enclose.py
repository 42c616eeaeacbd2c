"""A graph evaluated in intervals: bounds on a function over boxes, and boxes on which it is defined without jumps."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from covariant.lowering._graph import LARGEST
from covariant.lowering._intervals import INTERVALS, as_number, both, constant, eq, le, lt
from covariant.lowering._lowered import Conditions, Lowered
from covariant.lowering._read import Domain, evaluate_nodes
from covariant.lowering._tape import Interval, Truth, kernel


class Enclosure(NamedTuple):
    """Bounds on the values of a graph over boxes.

    - `low`, `high`: bounds (B, outputs); NaN where nothing is known.
    - `smooth`: which boxes (B,) have every choice decided, so that the function does not jump there.
    """

    low: np.ndarray
    high: np.ndarray
    smooth: np.ndarray


JUMPS = ("select", "either", "sign", "floor", "ceil", "round", "atan2")
"""Operations whose values may jump."""


@kernel
def decided(p: Truth) -> Truth:
    """Boxes on which a choice by a statement does not jump."""
    known = p.must | ~p.may
    return Truth(known, known)


@kernel
def unequal(a: Interval, b: Interval) -> Truth:
    known = (a.high < b.low) | (a.low > b.high)
    return Truth(known, known)


@kernel
def not_zero(a: Interval) -> Truth:
    """Boxes on which a sign does not jump: zero has a sign of its own, 0."""
    known = (a.low > 0) | (a.high < 0)
    return Truth(known, known)


@kernel
def off_the_cut(y: Interval, x: Interval) -> Truth:
    """Boxes on which an angle does not jump.

    The cut is the negative half-axis with the origin; values on it belong to the upper side.
    """
    known = ~((y.low <= 0) & (y.high >= 0) & (x.low <= 0)) | (y.low >= 0) & (x.high < 0)
    return Truth(known, known)


@kernel
def one_value(found: Interval) -> Truth:
    known = found.low == found.high
    return Truth(known, known)


def _no_jump(op: str, arguments: tuple, found: Any) -> Truth:
    """Boxes on which an operation of `JUMPS` does not jump."""
    match op:
        case "select":
            return decided(arguments[0])
        case "either":
            return unequal(*arguments[:2])
        case "sign":
            return not_zero(*arguments)
        case "atan2":
            return off_the_cut(*arguments)
    return one_value(found)


def by_numpy(lowered: Lowered, low: np.ndarray, high: np.ndarray) -> Enclosure:
    """Bounds on the values of a graph over boxes with `corners`, by NumPy."""
    inputs = [Interval(a, b) for a, b in zip(low.T.copy(), high.T.copy(), strict=True)]
    with np.errstate(all="ignore"):
        values, smooth = bounds(lowered, inputs)
    found = np.empty((2, len(values), len(low)))
    for k, value in enumerate(values):
        found[0, k], found[1, k] = value
    return Enclosure(found[0].T, found[1].T, np.broadcast_to(smooth.must, len(low)).copy())


def bounds(lowered: Lowered, inputs: Sequence[Interval]) -> tuple[list[Interval], Truth]:
    """Bounds on the values, and where the function does not jump, from those of its inputs."""
    smooth: Truth = constant(True)  # pyright: ignore[reportAssignmentType]

    def watched(op: str) -> Callable:
        def apply(*arguments: Any) -> Any:
            nonlocal smooth
            found = INTERVALS[op](*arguments)
            smooth = both(smooth, _no_jump(op, arguments, found))
            return found

        return apply

    domain = {**INTERVALS, **{op: watched(op) for op in JUMPS}}
    values = evaluate_nodes(lowered.graph, lowered.outputs, domain, inputs)
    for value in values:
        if isinstance(value, Truth):
            smooth = both(smooth, decided(value))
    return [as_number(value) for value in values], smooth


def corners(low: np.ndarray, high: np.ndarray, inputs: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners of boxes as arrays of doubles (B, inputs). Raises `ValueError` where they are none."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    if low.ndim != 2 or low.shape != high.shape or low.shape[1] != inputs:
        raise ValueError(f"boxes of this graph have corners (B, {inputs}); got {low.shape} and {high.shape}")
    wrong = np.argwhere(~(low <= high))
    if wrong.size:
        box, entry = wrong[0]
        raise ValueError(
            f"a box has low <= high; box {box} has low {low[box, entry]} and high {high[box, entry]} in input {entry}"
        )
    return low, high


# Where a function is defined and does not jump. Here a comparison is decided only strictly: where both sides may be
# equal, on a face of a box or at a variable that is held fixed, what depends on the comparison may jump there.


class Step(Interval):
    """A number that is constant around each point of a box, given its own conditions, such as a floor."""


def _strictly(a: Interval | Truth, b: Interval | Truth) -> Truth:
    """a < b; also for a ≤ b, since equality counts as undecided."""
    a, b = as_number(a), as_number(b)
    return Truth(a.high < b.low, ~(a.low > b.high))


def _on_steps(rule: Callable, otherwise: Callable) -> Callable:
    """A rule for arguments that are locally constant, and another for arguments that change."""

    return lambda *arguments: (_stepping(rule) if all(isinstance(a, Step | Truth) for a in arguments) else otherwise)(
        *arguments
    )


def _stepping(rule: Callable) -> Callable:
    def apply(*arguments: Any) -> Any:
        found = rule(*arguments)
        return Step(*found) if isinstance(found, Interval) else found

    return apply


def _same(a: Any, b: Any) -> Truth:
    """Equality of numbers that change: decided only where they are the same node, or have disjoint intervals."""
    return eq(a, b) if a is b else Truth(np.zeros_like(eq(a, b).must), eq(a, b).may)


STRICT: Domain = {
    **{op: _on_steps(rule, rule) for op, rule in INTERVALS.items()},
    "constant": _stepping(constant),
    "lt": _on_steps(lt, _strictly),
    "le": _on_steps(le, _strictly),
    "eq": _on_steps(eq, _same),
    **{op: _stepping(INTERVALS[op]) for op in ("floor", "ceil", "round", "sign")},
}


def fulfilled(conditions: Conditions, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which conditions hold on all of which boxes (B, conditions), with corners (B, inputs): True only where proved."""
    low, high = corners(low, high, conditions.inputs)
    found = np.zeros((len(low), len(conditions.conditions)), bool)
    if not found.size:
        return found
    inputs = [Interval(a, b) for a, b in zip(low.T.copy(), high.T.copy(), strict=True)]
    with np.errstate(all="ignore"):
        values = evaluate_nodes(conditions.graph, [c.node for c in conditions.conditions], STRICT, inputs)
    for k, (condition, value) in enumerate(zip(conditions.conditions, values, strict=True)):
        if condition.kind == "finite":
            found[:, k] = (value.low > -LARGEST) & (value.high < LARGEST)
        elif condition.kind == "whole":
            below = np.floor(value.low)
            found[:, k] = isinstance(value, Step) or (below < value.low) & (np.floor(value.high) == below)
        else:
            found[:, k] = value.must if condition.kind == "true" else value.must | ~value.may
    return found
