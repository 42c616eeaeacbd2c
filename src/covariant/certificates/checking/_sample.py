"""Checks random leaves of a saved certificate in ball arithmetic with many digits, as a third, independent check."""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from covariant._domains import Count, Whole, check_numbers
from covariant._optional import load_optional
from covariant.certificates.base import (
    FORMS,
    DisturbanceClaim,
    Document,
    PredictionClaim,
    Resolved,
    disturbance_bound,
    joint_force_bound,
    parse,
)
from covariant.certificates.checking._check import follows
from covariant.certificates.checking._matrices import prediction_of_steps, sizes
from covariant.certificates.sampled import defect_bound
from scalargraph.proofs import BITS, BallMatrix, Form
from scalargraph.proofs.checker import leaves

MOST_VARIABLES = 10
"""Largest number of variables of a leaf that is checked whole."""
PART = 64
"""Ratio of a leaf with many variables to its checked part, in every direction."""


class Sampled(NamedTuple):
    """Result of a successful check of random leaves.

    Attributes:
        leaves: number of leaves that were examined, all of which were confirmed.
        total: number of all leaves.
        boxes: number of boxes that were evaluated.
        seconds: time it took [s].

    Example:
        >>> from covariant.certificates.checking import Sampled
        >>> result = Sampled(leaves=20, total=400, boxes=35, seconds=1.5)  # usually from `check_sample`
        >>> result.leaves / result.total
        0.05
    """

    leaves: int
    total: int
    boxes: int
    seconds: float


@check_numbers
def check_sample(source: str | Path | Document, count: Count = 20, seed: Whole = 0, *, model: object = None) -> Sampled:
    """Check random leaves of a saved certificate, drawn from all its claims, in ball arithmetic with many digits.

    Balls bound derivatives operation by operation, which needs smaller boxes than the Taylor models of the proof, so
    leaves are halved. Two kinds of leaves are too large for that: leaves with more than ten variables, and leaves on
    the steps of predictions. Of these only a random part is checked.

    Args:
        source: the file, or its content from `parse`.
        count: number of leaves, at least one.
        seed: seed of the random numbers.
        model: as for `check`.

    Returns:
        Numbers of leaves and boxes.

    Raises:
        ValueError: a box is not confirmed, and the message names it; or there are no leaves.
        ImportError: python-flint is missing.
    """
    start = time.monotonic()
    flint = load_optional("flint", use="checking in balls needs python-flint, imported as", extra="balls")
    document = source if isinstance(source, Document) else parse(source)
    resolved, claims = follows(document, model), document.claims
    boxes = [leaves(*document.bounds(claim), claim.levels, f"claims[{index}]") for index, claim in enumerate(claims)]
    ends = np.cumsum([len(low) for low, _ in boxes])
    rng = np.random.default_rng(seed)
    # Drawn without repetition over all claims together, so that each leaf has the same probability.
    drawn = np.sort(rng.permutation(ends[-1])[:count])
    evaluated = 0
    with flint.ctx.workprec(BITS):
        for index, claim in enumerate(claims):
            chosen = drawn[(drawn < ends[index]) & (drawn >= ends[index] - len(boxes[index][0]))]
            if not len(chosen):
                continue
            form = BallMatrix(flint, _FORMS[claim.kind](resolved, claim), *document.bounds(claim))
            for k in chosen - (ends[index] - len(boxes[index][0])):
                leaf = boxes[index][0][k], boxes[index][1][k]
                # Derivatives of the defect of steps are too wide for balls on a whole leaf.
                large = form.reads > MOST_VARIABLES or isinstance(claim, PredictionClaim)
                piece = _part(*leaf, rng) if large else leaf
                evaluated += form.show(*piece, f"{document.file}: leaf {k} of claims[{index}]")
    return Sampled(len(drawn), int(ends[-1]), evaluated, time.monotonic() - start)


def _part(low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random part of a box."""
    start = low + rng.uniform(size=len(low)) * (1 - 1 / PART) * (high - low)
    return start, np.minimum(start + (high - low) / PART, high)


def _disturbance(of: Resolved, claim: DisturbanceClaim) -> Form:
    if of.document.sampling is None:
        return disturbance_bound(of.about, sizes(of.document), claim.square)
    return joint_force_bound(of.about, of.document.given.disturbance, claim.square)


_FORMS = FORMS | {
    "disturbance": _disturbance,
    "prediction": lambda of, claim: defect_bound(
        prediction_of_steps(of.document, of.observer), claim.square, claim.order
    ),
}
"""The forms of all claims, including those that need the checker's bounds of noise or the observer that runs."""
