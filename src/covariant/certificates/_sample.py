"""A check of random leaves of a saved certificate in ball arithmetic with many digits: a third, independent one."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from covariant._optional import load_optional
from covariant.certificates._check import follows, sizes
from covariant.certificates._document import Document, Stated, parse
from covariant.certificates._inequalities import contraction, disturbance_bound, width_bound
from covariant.certificates._subject import Subject
from covariant.proofs import BITS, MOST_DERIVED, BallMatrix, Form
from covariant.proofs.checker import leaves

PART = 64
"""Of leaves with many variables a part is looked at, this many times as small in every direction."""


class Sampled(NamedTuple):
    """Number of leaves looked at and found right, of all leaves; number of boxes this took, and time [s]."""

    leaves: int
    total: int
    boxes: int
    seconds: float


def check_sample(source: str | Path | Document, count: int = 20, seed: int = 0, *, model: Any = None) -> Sampled:
    """Check `count` random leaves of a saved certificate, a file or its parsed content, drawn from all its claims.

    Balls bound derivatives, one operation after the other. Of a leaf with more than `MOST_DERIVED` variables, which is
    proved by Taylor models, only a random part is small enough for that, and shown.

    `model`: as for `check`. Raises `ValueError` naming a box that is not shown to be right, `ImportError` where
    python-flint is missing.
    """
    start = time.monotonic()
    flint = load_optional("flint", use="checking in balls needs python-flint, imported as", extra="balls")
    document = source if isinstance(source, Document) else parse(source)
    about, claims, low, high = follows(document, model).about, document.claims, document.low, document.high
    boxes = [leaves(low, high, claim.levels, f"claims[{index}]") for index, claim in enumerate(claims)]
    ends = np.cumsum([len(low) for low, _ in boxes])
    rng = np.random.default_rng(seed)
    drawn = np.sort(rng.permutation(ends[-1])[:count])
    done = 0
    with flint.ctx.workprec(BITS):
        for index, claim in enumerate(claims):
            mine = drawn[(drawn < ends[index]) & (drawn >= ends[index] - len(boxes[index][0]))]
            if not len(mine):
                continue
            form = BallMatrix(flint, _form(claim, about, document), low, high)
            for k in mine - (ends[index] - len(boxes[index][0])):
                leaf = boxes[index][0][k], boxes[index][1][k]
                shown = _part(*leaf, rng) if form.reads > MOST_DERIVED else leaf
                done += form.show(*shown, f"{document.file}: leaf {k} of claims[{index}]")
    return Sampled(len(drawn), int(ends[-1]), done, time.monotonic() - start)


def _part(low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random part of a box."""
    start = low + rng.uniform(size=len(low)) * (1 - 1 / PART) * (high - low)
    return start, np.minimum(start + (high - low) / PART, high)


def _form(claim: Stated, about: Subject, document: Document) -> Form:
    if claim.kind == "contraction":
        return contraction(about, document.rate)
    if claim.kind == "reach":
        return width_bound(about, claim.row, claim.square)
    return disturbance_bound(about, sizes(document), claim.square)
