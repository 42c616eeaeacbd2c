"""Two or three steps of a program as one, where the outer one alone reads what the inner ones find.

The operations are the same, so the results are. What is saved is the way of intermediate bounds through memory, and the
choice of a step, which together cost as much as a sum of intervals.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from covariant.lowering._program import KERNELS, Interval, Kernel, Program, Step

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


def fused(program: Program, outputs: Sequence[int]) -> list[Step]:
    """The steps of a program that finds the numbers at the places `outputs`, with some of them joined."""
    uses = Counter(place for step in program.steps for place in step.arguments)
    uses.update(outputs)
    made = {step.results: step for step in program.steps if all(uses[place] <= 1 for place in step.results)}
    done: set[tuple[int, int]] = set()
    steps = []
    for step in reversed(program.steps):
        if step.results in done:
            continue
        found = [made.get(pair) for pair in zip(step.arguments[::2], step.arguments[1::2], strict=True)]
        for inner, turned in _options(step.kernel):
            order = found[::-1] if turned else found
            if all(not name or (one and one.kernel == name) for name, one in zip(inner, order, strict=True)):
                joined = [one if name else None for name, one in zip(inner, order, strict=True)]
                done.update(one.results for one in joined if one)
                step = _with_inner(step, inner, joined, turned)
                break
        steps.append(step)
    return steps[::-1]


def _options(outer: str) -> list[tuple[tuple[str, ...], bool]]:
    return [
        (inner, turned)
        for name, inner in PAIRS
        if name == outer
        for turned in ((False, True) if outer in SYMMETRIC else (False,))
    ]


def _with_inner(step: Step, inner: Sequence[str], joined: Sequence[Step | None], turned: bool) -> Step:
    own = [step.arguments[k : k + 2] for k in range(0, len(step.arguments), 2)]
    ends = zip(own[::-1] if turned else own, joined, strict=True)
    arguments = tuple(place for pair, one in ends for place in (one.arguments if one else pair))
    return Step(_name(step.kernel, inner), step.results, arguments)
