"""Two or three steps of a tape as one, where the outer one alone reads what the inner ones find.

The operations are the same, so the results are. What is saved is the way of intermediate bounds through memory, and the
choice of a step, which together cost as much as a sum of intervals.
"""

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from covariant.lowering._tape import KERNELS, Interval, Kernel, Step, Tape

PAIRS = (
    ("add", ("products", "products")),
    ("add", ("add", "products")),
    ("add", ("add", "add")),
    ("add", ("", "products")),
    ("add", ("", "add")),
    ("sub", ("", "products")),
    ("sub", ("add", "add")),
    ("neg", ("add",)),
    ("neg", ("products",)),
    ("neg", ("times_number",)),
    ("products", ("", "neg")),
    ("times_number", ("neg", "")),
    ("times_number", ("add", "")),
    ("over_number", ("add", "")),
    ("over_number", ("sub", "")),
    ("quotients", ("sub", "")),
)
"""Outer steps, and for each of their arguments the step that finds it, where it becomes part of the outer one.

They are the most frequent in derivatives of products and quotients. An earlier one of an outer step is preferred.
"""
SYMMETRIC = ("add", "products")


def _name(outer: str, inner: Sequence[str]) -> str:
    return "_of_".join([outer, "_and_".join(name or "it" for name in inner)])


def _joined(outer: str, inner: Sequence[str]) -> Kernel:
    formulas = [KERNELS[name].formula if name else None for name in inner]
    counts = [len(KERNELS[name].arguments) if name else 1 for name in inner]

    def formula(*arguments: Any) -> Any:
        left = iter(arguments)
        found = [
            next(left) if one is None else one(*(next(left) for _ in range(count)))
            for one, count in zip(formulas, counts, strict=True)
        ]
        return KERNELS[outer].formula(*found)

    return Kernel(formula, (Interval,) * sum(counts), KERNELS[outer].result)


KERNELS.update({_name(outer, inner): _joined(outer, inner) for outer, inner in PAIRS})


class _Way(NamedTuple):
    """A way to join steps: the kernel, the inner kernels by the place of their argument, and if the outer is turned."""

    kernel: str
    inner: tuple[tuple[int, str], ...]
    turned: bool


def _ways(outer: str) -> list[_Way]:
    found = []
    for name, inner in PAIRS:
        for turned in (False, True) if outer in SYMMETRIC else (False,):
            if name == outer:
                places = ((1 - k if turned else k, one) for k, one in enumerate(inner) if one)
                found.append(_Way(_name(outer, inner), tuple(places), turned))
    return found


WAYS = {outer: _ways(outer) for outer, _ in PAIRS}


def fused(tape: Tape, outputs: Sequence[int]) -> list[Step]:
    """The steps of a tape that finds the numbers at the places `outputs`, with some of them joined."""
    uses = Counter(itertools.chain(outputs, *(step.arguments for step in tape.steps)))
    made = {step.results: step for step in tape.steps if uses[step.results[0]] <= 1 >= uses[step.results[1]]}
    done: set[tuple[int, ...]] = set()
    steps = []
    for step in reversed(tape.steps):
        if step.results in done:
            continue
        if step.kernel in WAYS:
            read = iter(step.arguments)
            found = [made.get(pair) for pair in zip(read, read, strict=True)]
            kinds = [one.kernel if one else "" for one in found]
            for way in WAYS[step.kernel]:
                if all(kinds[k] == name for k, name in way.inner):
                    done.update(found[k].results for k, _ in way.inner)  # pyright: ignore[reportOptionalMemberAccess]
                    step = _joined_step(step, way, found)
                    break
        steps.append(step)
    return steps[::-1]


def _joined_step(step: Step, way: _Way, found: Sequence[Step | None]) -> Step:
    parts = [step.arguments[k : k + 2] for k in range(0, len(step.arguments), 2)]
    for k, _ in way.inner:
        parts[k] = found[k].arguments  # pyright: ignore[reportOptionalMemberAccess]
    return Step(way.kernel, step.results, tuple(itertools.chain(*(parts[::-1] if way.turned else parts))))
