"""What a certificate of the sampled step needs besides its claims: bounds of forces and friction, and definedness."""

from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np

from covariant.certificates import _matrices as matrices
from covariant.certificates._document import Document, Stated
from covariant.certificates._error_system import ErrorSystem
from covariant.certificates._radius_recursion import Recursion
from covariant.models import MechanicalSystem
from covariant.proofs.checker import TaylorEnclosure

SLACK = 2.0**-20
"""Relative margin by which forces may exceed their bounds, so that bounds that are attained can be shown quickly."""


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
    yield "the bound of the friction's slopes", *speeds[:, None]
    yield "the smoothness of the friction", *speeds[:, None]
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
    low, high, inputs, speeds = document.low, document.high, document.given.inputs, _speeds(document)
    if what.startswith("the definedness of the correction"):
        claim = next(c for c in document.claims if c.kind == "correction" and f"after {c.row} lost" in what)
        ends = np.concatenate([np.array(document.bounds(claim)), np.zeros((2, 2 * n + 1))], axis=1)
        return TaylorEnclosure(matrices.all_corrections(system), ends[0], ends[1], np.zeros(ends.shape[1]), "smooth")
    slack = slack_of(low, high) / 2

    def within(function, k, unknown=0.0):
        part = slice(k * n, (k + 1) * n)
        return matrices.within(function, low[part] + unknown - slack[part], high[part] - unknown + slack[part])

    force, friction = matrices.input_force(model, n), matrices.friction(model, n)
    kinds: dict[str, tuple[Any, np.ndarray, Literal["", "defined", "smooth"]]] = {
        "the bound of the input's force": (within(force, 3), inputs, ""),
        "the definedness of the input's force": (force, inputs, "defined"),
        "the bound of the joint force": (
            # A force that the model lacks may be added to both.
            within(lambda y: force(y[:-n]) + friction(y[-n:]), 4, document.given.disturbance),
            np.concatenate([inputs, speeds], axis=1),
            "",
        ),
        "the bound of the friction's slopes": (within(matrices.friction_slopes(model, n), 5), speeds, ""),
        "the smoothness of the friction": (friction, speeds, "smooth"),
    }
    function, box, watch = kinds[what]
    return TaylorEnclosure(function, box[0], box[1], np.zeros(box.shape[1]), watch)


def sampled_claim_matrices(
    document: Document, system: ErrorSystem, claim: Stated
) -> dict[str, Callable[[], matrices.Matrix]]:
    """Build the matrices of the claims that are others with samples, by kind.

    Args:
        document: the parsed file.
        system: observer and metric as functions of a box.
        claim: the claim.
    """
    if document.sampling is None:
        return {}
    given = document.given
    return {
        "disturbance": lambda: matrices.joint_force(system, given.disturbance, claim.square),
        "correction": lambda: matrices.correction(system, given.noise if claim.squares else None, claim.squares),
        "missing": lambda: matrices.missing(system, claim.square, claim.limit, document.unit_reach),
    }


def need_sampled_rate_and_radius(document: Document) -> None:
    """Check that a rate is left, and that noise and unknown forces do not lead out of the radius.

    Args:
        document: the parsed file, all of whose claims are there.

    Raises:
        ValueError: saying what is wrong.
    """
    assert document.sampling is not None
    rate, radius, loss, given = document.rate, document.radius, document.loss, document.given
    if not loss.allowed(rate):
        slower = f"{loss.rate:.6g} 1/s by the factor of the correction, up to {loss.restart:.6g} of a restart"
        raise ValueError(f"rate: nothing is left of {rate / 2:.6g} 1/s, less {slower}")
    bounds = {"noise": given.noise, "disturbance": given.disturbance}
    recursion = Recursion.of(document.sampling, document.q, rate, bounds, document.claims)
    if recursion.disturbed and not recursion.keeps(radius):
        farthest = recursion.largest(radius)
        raise ValueError(f"radius: noise and disturbance lead out of {radius:.6g}, to {farthest:.6g}")


def slack_of(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return by how much (d,) variables that are forces may exceed their bounds.

    Args:
        low, high: bounds (d,).
    """
    # The last term serves bounds that are zero.
    return SLACK * np.maximum(abs(low), abs(high)) + 1e-200
