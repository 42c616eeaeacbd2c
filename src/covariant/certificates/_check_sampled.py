"""What a certificate of the sampled step needs besides its claims: bounds of forces and friction, and definedness.

The bounds of friction serve certificates in continuous time too, where friction and its slopes are variables.
"""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from covariant.certificates import _matrices as matrices
from covariant.certificates._document import Document
from covariant.certificates._error_system import ErrorSystem
from covariant.models import MechanicalSystem
from covariant.proofs.checker import TaylorEnclosure

SLACK = 2.0**-20
"""Relative margin by which forces may exceed their bounds, so that bounds that are attained can be shown quickly."""

FRICTION_JOBS = "the bound of the friction", "the bound of the friction's slopes", "the smoothness of the friction"
"""What is to be shown where friction and its slopes are variables; with samples their sum with the force is bounded."""


def friction_jobs(document: Document) -> Iterator[tuple]:
    """List what is to be shown where friction and its slopes are variables in continuous time, with its boxes.

    Args:
        document: the parsed file.
    """
    for what in FRICTION_JOBS:
        yield what, *_speeds(document)[:, None]


def friction_matrix(document: Document, model: MechanicalSystem, what: str) -> TaylorEnclosure:
    """Build the matrix of one of `FRICTION_JOBS`, which is to be shown positive definite.

    Args:
        document: the parsed file.
        model: the mechanical system.
        what: name of the job.
    """
    n, speeds = len(document.velocity), _speeds(document)
    friction, watch = matrices.friction(model, n), ""
    if what == FRICTION_JOBS[0]:
        function = _within(document, friction, 4)
    elif what == FRICTION_JOBS[1]:
        function = _within(document, matrices.friction_slopes(model, n), 5)
    else:
        function, watch = friction, "smooth"
    return TaylorEnclosure(function, speeds[0], speeds[1], np.zeros(n), watch)


def _within(document: Document, function: Any, k: int) -> Any:
    """That a function stays within the bounds, with half the slack, of the k-th n variables of the box."""
    part = slice(k * len(document.velocity), (k + 1) * len(document.velocity))
    low, high = document.low[part], document.high[part]
    slack = slack_of(low, high) / 2
    return matrices.within(function, low - slack, high + slack)


def sampled_jobs(document: Document, pins: np.ndarray) -> Iterator[tuple]:
    """List what is to be shown besides the claims, with its boxes: forces and friction, and ages of corrections.

    Args:
        document: the parsed file.
        pins: zeros (2, 2n + 1) at which time and state are held.
    """
    if document.sampling is None:
        return
    inputs, speeds = document.given.inputs, _speeds(document)
    both = np.concatenate([inputs, speeds], axis=1)
    yield "the bound of the input's force", *inputs[:, None]
    yield "the definedness of the input's force", *inputs[:, None]
    yield "the bound of the joint force", *both[:, None]
    for what in FRICTION_JOBS[1:]:
        yield what, *speeds[:, None]
    for claim in document.claims:
        if claim.kind == "correction":
            ends = np.concatenate([np.array(document.bounds(claim)), pins], axis=1)
            yield f"the definedness of the correction after {claim.row} lost, without jumps,", *ends[:, None]


def _speeds(document: Document) -> np.ndarray:
    """Bounds (2, n) of the estimated velocity."""
    n = len(document.velocity)
    return np.stack([document.low[n : 2 * n], document.high[n : 2 * n]])


def sampled_matrix(document: Document, system: ErrorSystem, model: MechanicalSystem, what: str) -> TaylorEnclosure:
    """Build the matrix of one of `sampled_jobs`, which is to be shown positive definite.

    Args:
        document: the parsed file.
        system: observer and metric as functions of a box.
        model: the mechanical system.
        what: name of the job.
    """
    n = len(document.velocity)
    inputs, speeds = document.given.inputs, _speeds(document)
    if what.startswith("the definedness of the correction"):
        claim = next(c for c in document.claims if c.kind == "correction" and f"after {c.row} lost" in what)
        ends = np.concatenate([np.array(document.bounds(claim)), np.zeros((2, 2 * n + 1))], axis=1)
        return TaylorEnclosure(matrices.all_corrections(system), ends[0], ends[1], np.zeros(ends.shape[1]), "smooth")
    force, friction = matrices.input_force(model, n), matrices.friction(model, n)
    kinds: dict[str, tuple[Any, np.ndarray, Literal["", "defined", "smooth"]]] = {
        "the bound of the input's force": (_within(document, force, 3), inputs, ""),
        "the definedness of the input's force": (force, inputs, "defined"),
        "the bound of the joint force": (
            _within(document, lambda y: force(y[:-n]) + friction(y[-n:]), 4),
            np.concatenate([inputs, speeds], axis=1),
            "",
        ),
    }
    function, box, watch = kinds[what]
    return TaylorEnclosure(function, box[0], box[1], np.zeros(box.shape[1]), watch)


def slack_of(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return by how much (d,) variables that are forces may exceed their bounds.

    Args:
        low, high: bounds (d,).
    """
    # The last term serves bounds that are zero.
    return SLACK * np.maximum(abs(low), abs(high)) + 1e-200
