"""Evaluates a graph in intervals: bounds a function over boxes, and finds boxes without undefined values or jumps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from scalargraph.errors import InputError
from scalargraph.graph import LARGEST, Conditions, Domain, Lowered, evaluate_nodes
from scalargraph.intervals._intervals import INTERVALS, as_number, constant, eq, le, lt
from scalargraph.intervals._types import Interval, Truth


class Enclosure(NamedTuple):
    """Bounds on the values of a function over boxes.

    Attributes:
        low: Lower bounds (B, outputs); NaN where nothing is known.
        high: Upper bounds (B, outputs); NaN where nothing is known.
        smooth: Boxes (B,) on which every choice is decided, so that the function does not jump there.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> lowered = scalargraph.lower(lambda x: jnp.sign(x), jnp.array(0.0))
        >>> low, high = np.array([[1.0], [-1.0]]), np.array([[2.0], [1.0]])
        >>> scalargraph.enclose(lowered, low, high).smooth.tolist()
        [True, False]
    """

    low: np.ndarray
    high: np.ndarray
    smooth: np.ndarray


JUMPS = ("select", "either", "sign", "floor", "ceil", "round", "atan2")
"""Operations whose values may jump."""


def _decided(p: Truth) -> Bool[np.ndarray, "B"]:
    """Boxes on which a choice by a statement does not jump: the statement holds everywhere or nowhere on the box."""
    return p.must | ~p.may


def _no_jump(op: str, arguments: tuple, result: Interval) -> Bool[np.ndarray, "B"]:
    """Boxes on which an operation of `JUMPS` does not jump."""
    match op:
        case "select":
            return _decided(arguments[0])
        case "either":
            a, b = arguments[:2]
            return (a.high < b.low) | (a.low > b.high)
        case "sign":
            # 0 is excluded, since its sign differs from those of all other numbers.
            return (arguments[0].low > 0) | (arguments[0].high < 0)
        case "atan2":
            # The cut of the angle is y = 0, x ≤ 0; values on it belong to the upper side. For x < 0 the angle is
            # continuous up to the cut from y ≥ 0, hence the second term.
            y, x = arguments
            return ~((y.low <= 0) & (y.high >= 0) & (x.low <= 0)) | (y.low >= 0) & (x.high < 0)
    # A function that is constant between its jumps, such as floor, has one value.
    return result.low == result.high


def enclose(lowered: Lowered, low: np.ndarray, high: np.ndarray) -> Enclosure:
    """Bound the values of a function over boxes, rigorously.

    Use it to bound a function over a region with certainty, which samples cannot do. The bounds are safe but may be
    wide, since each occurrence of a variable counts as an independent variable: halve the boxes for tighter bounds.
    `proofs.prove` does this for matrices until a verdict is reached.

    Args:
        lowered: The function, without loops or tables.
        low: Lower corners of the boxes (B, inputs).
        high: Upper corners (B, inputs), low ≤ high.

    Returns:
        The bounds of each output over each box, rounding errors included. Statements are bounded as the numbers 0 and
        1.

    Raises:
        ValueError: The corners have another shape, are NaN, or low exceeds high; or the function has loops or tables.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> square = scalargraph.lower(lambda x: x * x, jnp.array(0.0))
        >>> bounds = scalargraph.enclose(square, np.array([[-1.0]]), np.array([[2.0]]))
        >>> bounds.low.round(9).tolist(), bounds.high.round(9).tolist()
        ([[0.0]], [[4.0]])
    """
    low, high = corners(low, high, lowered.inputs)
    # A loop may never end in intervals, as its condition stays undecided; a table would be read at one index only.
    if odd := {node.op for node in lowered.graph.nodes} & {"loop", "table"}:
        raise InputError(f"a function with a {min(odd)} has no bounds; lower it with loops='unrolled'")
    inputs = [Interval(a, b) for a, b in zip(low.T.copy(), high.T.copy(), strict=True)]
    smooth = np.ones(len(low), bool)

    def watched(op: str) -> Callable:
        def apply(*arguments: Interval | Truth) -> Any:
            nonlocal smooth
            result = INTERVALS[op](*arguments)
            smooth = smooth & _no_jump(op, arguments, result)
            return result

        return apply

    domain: Domain = {**INTERVALS, **{op: watched(op) for op in JUMPS}}
    ends = np.empty((2, len(lowered.outputs), len(low)))
    with np.errstate(all="ignore"):
        values = evaluate_nodes(lowered.graph, lowered.outputs, domain, inputs)
        for k, value in enumerate(values):
            if isinstance(value, Truth):
                smooth = smooth & _decided(value)
            ends[0, k], ends[1, k] = as_number(value)
    return Enclosure(ends[0].T, ends[1].T, smooth)


def corners(low: np.ndarray, high: np.ndarray, inputs: int) -> tuple[np.ndarray, np.ndarray]:
    """Check corners of boxes and convert them to arrays of doubles (B, inputs)."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    if low.ndim != 2 or low.shape != high.shape or low.shape[1] != inputs:
        raise InputError(f"boxes of this graph have corners (B, {inputs}); got {low.shape} and {high.shape}")
    # Written with a negation, so that NaN, which fails every comparison, is invalid too.
    invalid = np.argwhere(~(low <= high))
    if invalid.size:
        box, entry = invalid[0]
        raise InputError(
            f"a box has low <= high; box {box} has low {low[box, entry]} and high {high[box, entry]} in input {entry}"
        )
    return low, high


# Conditions under which a function is defined and does not jump. A comparison is decided only if it is strict: if both
# sides may be equal, on a face of a box or for a fixed variable, a result that depends on the comparison may jump.


class Step(Interval):
    """A number that is constant around each point of a box where its conditions hold, such as a floor.

    Attributes:
        low: Lower bound (B,).
        high: Upper bound (B,).
    """


def _strictly(a: Interval | Truth, b: Interval | Truth) -> Truth:
    """a < b; also used for a ≤ b, since equality counts as undecided."""
    a, b = as_number(a), as_number(b)
    return Truth(a.high < b.low, ~(a.low > b.high))


def _on_steps(rule: Callable, otherwise: Callable) -> Callable:
    """A rule that depends on the arguments: `rule` if all are locally constant, else `otherwise`."""

    return lambda *arguments: (_stepping(rule) if all(isinstance(a, Step | Truth) for a in arguments) else otherwise)(
        *arguments
    )


def _stepping(rule: Callable) -> Callable:
    def apply(*arguments: Interval | Truth) -> Any:
        result = rule(*arguments)
        return Step(*result) if isinstance(result, Interval) else result

    return apply


def _same(a: Interval | Truth, b: Interval | Truth) -> Truth:
    """Equality of numbers that vary: decided only if they are the same node, or have disjoint intervals."""
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
    """Prove conditions on boxes.

    A comparison is decided only if it is strict: if both sides may be equal, a choice by it may jump.

    Args:
        conditions: The conditions of a function, `Lowered.conditions`.
        low: Lower corners of the boxes (B, inputs).
        high: Upper corners (B, inputs), low ≤ high.

    Returns:
        Whether each condition is proved on all of each box, (B, conditions).

    Raises:
        ValueError: The corners have another shape, are NaN, or low exceeds high.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> import scalargraph
        >>> conditions = scalargraph.lower(lambda x: jnp.log(x), jnp.array(1.0), real=True).conditions  # 0 < x
        >>> scalargraph.fulfilled(conditions, np.array([[0.5], [-1.0]]), np.array([[2.0], [1.0]])).tolist()
        [[True], [False]]
    """
    low, high = corners(low, high, conditions.inputs)
    proved = np.zeros((len(low), len(conditions.conditions)), bool)
    if not proved.size:
        return proved
    inputs = [Interval(a, b) for a, b in zip(low.T.copy(), high.T.copy(), strict=True)]
    with np.errstate(all="ignore"):
        values = evaluate_nodes(conditions.graph, [c.node for c in conditions.conditions], STRICT, inputs)
    for k, (condition, value) in enumerate(zip(conditions.conditions, values, strict=True)):
        if condition.kind == "finite":
            proved[:, k] = (value.low > -LARGEST) & (value.high < LARGEST)
        elif condition.kind == "whole":
            # It must lie strictly between two neighbouring integers, so that it neither equals nor crosses one.
            below = np.floor(value.low)
            proved[:, k] = isinstance(value, Step) or (below < value.low) & (np.floor(value.high) == below)
        else:
            proved[:, k] = value.must if condition.kind == "true" else value.must | ~value.may
    return proved
