"""Applies JAX's primitives to arrays of Taylor models, and tests whether each is defined and does not jump."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scalargraph.errors import InputError
from scalargraph.graph import ClosedJaxpr, Scan
from scalargraph.proofs.checker._taylor import (
    CURVES,
    HALF,
    ONE,
    RIGHT,
    ZERO,
    Taylor,
    choose,
    continuous,
    curve,
    decided,
    finite,
    floor,
    less,
    opposite,
    unequal,
)

ENTRIES: dict[str, Callable] = {
    **{name: functools.partial(curve, name) for name in CURVES},
    "add": lambda a, b: a + b,
    "add_any": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "neg": lambda a: -a,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "square": lambda a: a * a,
    "rsqrt": lambda a: curve("inv", curve("sqrt", a)),
    "cos": lambda a: curve("sin", a + RIGHT),
    "tan": lambda a: curve("sin", a) / curve("sin", a + RIGHT),
    # 1 − 2/(e²ᵃ + 1) contains a only once; a quotient of two exponentials would have a wider range.
    "tanh": lambda a: ONE - ONE / (HALF * (curve("exp", a + a) + ONE)),
    "logistic": lambda a: ONE / (ONE + curve("exp", -a)),
    "atan2": lambda y, x: (half := curve("atan", y / (x + curve("sqrt", x * x + y * y)))) + half,
    "expm1": lambda a: curve("exp", a) - ONE,
    "log1p": lambda a: curve("log", a + ONE),
    "sinh": lambda a: HALF * (curve("exp", a) - curve("exp", -a)),
    "cosh": lambda a: HALF * (curve("exp", a) + curve("exp", -a)),
    "pow": lambda a, b: curve("exp", b * curve("log", a)),
    "lt": less,
    "gt": lambda a, b: less(b, a),
    "le": lambda a, b: opposite(less(b, a)),
    "ge": lambda a, b: opposite(less(a, b)),
    "ne": unequal,
    "eq": lambda a, b: opposite(unequal(a, b)),
    "and": lambda a, b: a * b,
    "or": lambda a, b: a + b - a * b,
    "not": opposite,
    "select_n": lambda which, no, yes: choose(which, yes, no),
    "max": lambda a, b: choose(less(a, b), b, a),
    "min": lambda a, b: choose(less(a, b), a, b),
    "clamp": lambda low, a, high: ENTRIES["min"](ENTRIES["max"](a, low), high),
    "abs": lambda a: choose(less(a, ZERO), -a, a),
    # At zero the hull [−1, 1] contains both values and 0.
    "sign": lambda a: choose(less(a, ZERO), -ONE, ONE),
    # It differs from rounding to even only half-way between integers. This is a jump, for which
    # `_contains_no_integer` is false.
    "round": lambda a: floor(a + HALF),
    "floor": floor,
    "is_finite": finite,
}


# Conditions under which a primitive is defined, and conditions under which it does not jump.


def nonzero(a: Taylor) -> Any:
    """Whether a number differs from zero on the whole of each box (B,)."""
    # `away` is rounded up, so a strict comparison proves that zero lies outside the range; NaN compares as false.
    return abs(a.middle) > a.away


def _positive(a: Taylor) -> Any:
    return a.middle > a.away


def _contains_no_integer(a: Taylor) -> Any:
    """Whether the range, including its ends, contains no integer."""
    # Rounding is monotone: an integer k in the exact range also lies between the rounded ends, and one that is an end
    # itself fails the strict comparison. So no integer is missed.
    below = np.floor(a.middle - a.away)
    return (below < a.middle - a.away) & (np.floor(a.middle + a.away) == below)


def settled(which: Taylor | bool | np.bool_, *cases: Taylor) -> Any:
    """Whether a truth value is known, or the choice by it between two numbers does not jump."""
    if isinstance(which, bool | np.bool_) or (len(cases) == 2 and continuous(which, *cases)):
        return True
    return abs(which.middle - 0.5) > which.away


NEEDS: dict[str, Callable] = {
    "div": lambda a, b: nonzero(b),
    "inv": nonzero,
    **dict.fromkeys(("sqrt", "rsqrt", "log"), _positive),
    "log1p": lambda a: _positive(a + ONE),
    "pow": lambda a, b: _positive(a),
    "tan": lambda a: nonzero(curve("sin", a + RIGHT)),
    "atan2": lambda y, x: _positive(x) | nonzero(y),
}
STAYS: dict[str, Callable] = {
    "sign": nonzero,
    **dict.fromkeys(("floor", "ceil"), _contains_no_integer),
    "round": lambda a: _contains_no_integer(a + HALF),
    "select_n": settled,
}
"""Conditions under which each primitive is defined, and does not jump; primitives without an entry need none."""


# Operations on arrays of Taylor models.


def each(function: Callable, *x: Any) -> np.ndarray:
    """Apply a function entry by entry."""
    return np.asarray(np.frompyfunc(function, len(x), 1)(*x), object)


def _total(x: np.ndarray, axes: tuple[int, ...]) -> Any:
    return np.sum(x, axis=axes, initial=ZERO)  # pyright: ignore[reportCallIssue, reportArgumentType]


def _dot(p: dict, a: np.ndarray, b: np.ndarray) -> Any:
    (over, other), (batch, second) = p["dimension_numbers"]
    free, rest = ([k for k in range(x.ndim) if k not in axes] for x, axes in ((a, over + batch), (b, other + second)))
    start, end = len(batch), len(batch) + len(free)
    a = np.expand_dims(a.transpose(*batch, *free, *over), tuple(range(end, end + len(rest))))
    b = np.expand_dims(b.transpose(*second, *rest, *other), tuple(range(start, end)))
    return _total(a * b, tuple(range(-len(over), 0)))


def _power(p: dict, x: np.ndarray) -> Any:
    base = x if p["y"] > 0 else each(ENTRIES["inv"], x)
    return functools.reduce(np.multiply, [base] * abs(p["y"]), each(lambda _: ONE, x))


def _fold(name: str) -> Callable:
    """Reduce over some axes by an operation, one entry after the other."""

    def fold(p: dict, x: np.ndarray) -> Any:
        axes = tuple(p["axes"])
        rows = np.moveaxis(x, axes, range(len(axes)))
        rows = rows.reshape(math.prod(rows.shape[: len(axes)]), *rows.shape[len(axes) :])
        return functools.reduce(functools.partial(each, ENTRIES[name]), rows)

    return fold


def _broadcast(p: dict, x: np.ndarray) -> np.ndarray:
    sides = dict(zip(p["broadcast_dimensions"], x.shape, strict=True))
    return np.broadcast_to(x.reshape([sides.get(k, 1) for k in range(len(p["shape"]))]), p["shape"])


def _scatter_add(p: dict, x: np.ndarray, indices: np.ndarray, updates: np.ndarray) -> np.ndarray:
    """x with entries of `updates` added at known places, at most one to each place."""

    def placed(numbers: np.ndarray) -> np.ndarray:
        with jax.ensure_compile_time_eval():
            operands = jnp.zeros(x.shape), jnp.asarray(indices), jnp.asarray(numbers.reshape(updates.shape), float)
            return np.asarray(jax.lax.scatter_add_p.bind(*operands, **p)).ravel().astype(int)

    if placed(np.ones(updates.size, int)).max(initial=0) > 1:
        raise InputError("'scatter-add' with several terms for one place is not known to the check")
    sums, terms = x.ravel().copy(), updates.ravel()
    for place, term in enumerate(placed(np.arange(1, updates.size + 1))):
        if term:
            sums[place] = sums[place] + terms[term - 1]
    return sums.reshape(x.shape)


ARRAYS: dict[str, Callable] = {
    "dot_general": _dot,
    "integer_pow": _power,
    "reduce_sum": lambda p, x: _total(x, tuple(p["axes"])),
    **{f"reduce_{name}": _fold(name) for name in ("max", "min", "and", "or")},
    "argmax": lambda p, x: max(range(len(x)), key=functools.cmp_to_key(lambda i, j: 1 - 2 * decided(less(x[i], x[j])))),
    "scatter-add": _scatter_add,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda p, x: x.reshape(p["new_sizes"]),
    "squeeze": lambda p, x: np.squeeze(x, p["dimensions"]),
    "transpose": lambda p, x: x.transpose(p["permutation"]),
    "concatenate": lambda p, *x: np.concatenate(x, p["dimension"]),
    "rev": lambda p, x: np.flip(x, p["dimensions"]),
    "mirrored": lambda p, x, _: x,
    "slice": lambda p, x: x[
        tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or (None,) * x.ndim))
    ],
}
MOVES = {
    *("split", "pad", "gather", "scatter", "dynamic_slice", "dynamic_update_slice", "expand_dims"),
    *("copy", "copy_p", "convert_element_type", "stop_gradient"),
}
"""Primitives that only move entries; they are applied to the indices of the entries."""


def is_real(atom: Any) -> bool:
    """Whether a variable or literal of a jaxpr holds real numbers."""
    return _is_floating(atom.aval.dtype)


@functools.cache
def _is_floating(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.floating)


def unrolled(scan: Scan, x: list, run: Callable[[ClosedJaxpr, list], list], stack: Callable) -> list:
    """The results of a scan, one turn after the other."""
    first, last = scan.fixed, scan.fixed + scan.carried
    carry, rows = x[first:last], []
    # A reversed scan starts from the last row; its stacked results are in the order of the rows.
    order = range(scan.length)[:: -1 if scan.reverse else 1]
    for i in order:
        results = run(scan.body, [*x[:first], *carry, *(a[i] for a in x[last:])])
        carry, rows = results[: scan.carried], [*rows, results[scan.carried :]]
    return [*carry, *(stack(column) for column in zip(*rows[:: -1 if scan.reverse else 1], strict=True))]
