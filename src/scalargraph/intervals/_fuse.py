"""Fuses two or three steps of a tape into one, if only the outer step reads the results of the inner ones.

The fused step does the same operations and gives the same results. It saves storing intermediate bounds in memory and
selecting a further step, which together cost as much as a sum of intervals.
"""

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from scalargraph.intervals._tape import KERNELS, Interval, Kernel, Step, Tape

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
"""Fusions: an outer step, and for each of its arguments the inner step that computes it, or "" for none.

The listed pairs are the most frequent in derivatives of products and quotients. If several fit, the first one is used.
"""
SYMMETRIC = ("add", "products")


def _name(outer: str, inner: Sequence[str]) -> str:
    return "_of_".join([outer, "_and_".join(name or "it" for name in inner)])


def _compose_kernel(outer: str, inner: Sequence[str]) -> Kernel:
    formulas = [KERNELS[name].formula if name else None for name in inner]
    counts = [len(KERNELS[name].arguments) if name else 1 for name in inner]

    def formula(*arguments: Any) -> Any:
        remaining = iter(arguments)
        operands = [
            next(remaining) if one is None else one(*(next(remaining) for _ in range(count)))
            for one, count in zip(formulas, counts, strict=True)
        ]
        return KERNELS[outer].formula(*operands)

    return Kernel(formula, (Interval,) * sum(counts), KERNELS[outer].result)


KERNELS.update({_name(outer, inner): _compose_kernel(outer, inner) for outer, inner in PAIRS})


class _Fusion(NamedTuple):
    """Steps to join: the kernel, the inner kernels by argument, and whether the outer arguments are exchanged."""

    kernel: str
    inner: tuple[tuple[int, str], ...]
    turned: bool


def _fusions(outer: str) -> list[_Fusion]:
    fusions = []
    for name, inner in PAIRS:
        for turned in (False, True) if outer in SYMMETRIC else (False,):
            if name == outer:
                places = ((1 - k if turned else k, one) for k, one in enumerate(inner) if one)
                fusions.append(_Fusion(_name(outer, inner), tuple(places), turned))
    return fusions


WAYS = {outer: _fusions(outer) for outer, _ in PAIRS}


def fused(tape: Tape, outputs: Sequence[int]) -> list[Step]:
    """Return the steps of a tape with some of them joined."""
    uses = Counter(itertools.chain(outputs, *(step.arguments for step in tape.steps)))
    # A result with one reader is absorbed into the step that reads it; a result with several readers must be stored.
    unshared = {step.results: step for step in tape.steps if uses[step.results[0]] <= 1 >= uses[step.results[1]]}
    done: set[tuple[int, ...]] = set()
    steps = []
    # Steps are visited from the end, so that an outer step comes before the inner steps that it absorbs.
    for step in reversed(tape.steps):
        if step.results in done:
            continue
        if step.kernel in WAYS:
            read = iter(step.arguments)
            below = [unshared.get(pair) for pair in zip(read, read, strict=True)]
            kinds = [one.kernel if one else "" for one in below]
            for fusion in WAYS[step.kernel]:
                if all(kinds[k] == name for k, name in fusion.inner):
                    done.update(below[k].results for k, _ in fusion.inner)  # pyright: ignore[reportOptionalMemberAccess]
                    step = _join_step(step, fusion, below)
                    break
        steps.append(step)
    return steps[::-1]


def _join_step(step: Step, fusion: _Fusion, inner: Sequence[Step | None]) -> Step:
    parts = [step.arguments[k : k + 2] for k in range(0, len(step.arguments), 2)]
    for k, _ in fusion.inner:
        parts[k] = inner[k].arguments  # pyright: ignore[reportOptionalMemberAccess]
    return Step(fusion.kernel, step.results, tuple(itertools.chain(*(parts[::-1] if fusion.turned else parts))))
