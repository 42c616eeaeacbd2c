"""Lists what a certificate of the sampled step needs besides its claims: bounds of forces and friction, definedness.

The bounds of friction also serve certificates in continuous time if friction and its slopes are variables.
"""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from covariant.certificates.base import (
    CorrectionClaim,
    Document,
    ErrorSystem,
    PredictionClaim,
    Recursion,
    corrections,
    select,
)
from covariant.certificates.checking import _matrices as matrices
from covariant.certificates.sampled import step_values
from covariant.models import MechanicalSystem
from scalargraph.errors import InputError
from scalargraph.proofs.checker import TaylorEnclosure, jacobian

PREDICTED = "the definedness of predictions, without jumps,"
FRICTION_JOBS = "the bound of the friction", "the bound of the friction's slopes", "the smoothness of the friction"
"""Jobs if friction and its slopes are variables; with samples, the sum of friction and force is bounded instead."""


def friction_jobs(document: Document) -> Iterator[tuple]:
    """List the jobs, with their boxes, that show friction and its slopes, as variables in continuous time."""
    for what in FRICTION_JOBS:
        yield what, *_speeds(document)[:, None]


def friction_matrix(document: Document, model: MechanicalSystem, what: str) -> TaylorEnclosure:
    """Build the matrix of one of `FRICTION_JOBS`, which must be shown positive definite."""
    n, (low, high) = len(document.velocity), _speeds(document)
    friction = matrices.friction(model, n)
    functions = {
        FRICTION_JOBS[0]: _within(document, friction, 4),
        FRICTION_JOBS[1]: _within(document, matrices.friction_slopes(model, n), 5),
        FRICTION_JOBS[2]: friction,
    }
    return TaylorEnclosure(functions[what], low, high, np.zeros(n), "smooth" if what == FRICTION_JOBS[2] else "")


def _within(document: Document, function: Any, k: int, unknown: Any = 0.0, chosen: slice = slice(None)) -> Any:
    """A matrix that is positive definite if a function keeps the bounds of n variables of the box.

    The bounds are widened by half the slack and reduced by `unknown`. The variables are the k-th group of n variables,
    velocities first, or those `chosen` from it.
    """
    n = len(document.velocity)
    start = document.first_velocity + (k - 1) * n
    low, high = document.low[start : start + n], document.high[start : start + n]
    slack = matrices.slack_of(low, high) / 2
    least, most = (low + unknown - slack)[chosen], (high - unknown + slack)[chosen]
    return matrices.within(lambda y: function(y)[chosen], least, most)


def sampled_jobs(document: Document, pins: np.ndarray) -> Iterator[tuple]:
    """List the jobs besides the claims, with their boxes: forces and friction, and ages of corrections."""
    if document.sampling is None:
        return
    inputs, speeds = document.given.inputs, _speeds(document)
    both = np.concatenate([inputs, speeds], axis=1)
    yield "the bound of the input's force", *inputs[:, None]
    yield "the definedness of the input's force", *inputs[:, None]
    # Joint by joint, since a common proof would need the product of the numbers of boxes.
    for joint in range(1, len(document.velocity) + 1):
        yield f"the bound of the force with friction {joint}", *both[:, None]
        yield f"the bound of the friction's slope {joint}", *speeds[:, None]
    yield FRICTION_JOBS[2], *speeds[:, None]
    for claim in document.claims:
        if isinstance(claim, PredictionClaim):
            yield PREDICTED, *np.array(document.bounds(claim))[:, None]
        if isinstance(claim, CorrectionClaim):
            ends = np.concatenate([np.array(document.bounds(claim)), pins], axis=1)
            yield f"the definedness of the correction after {claim.row} lost, without jumps,", *ends[:, None]


def _speeds(document: Document) -> np.ndarray:
    """Bounds (2, n) of the estimated velocity."""
    n = len(document.velocity)
    start = document.first_velocity
    return np.stack([document.low[start : start + n], document.high[start : start + n]])


def sampled_matrix(document: Document, system: ErrorSystem, model: MechanicalSystem, what: str) -> TaylorEnclosure:
    """Build the matrix of one of `sampled_jobs`, which must be shown positive definite."""
    n = len(document.velocity)
    inputs, speeds = document.given.inputs, _speeds(document)
    if what.startswith("the definedness of the correction"):
        claim = next(c for c in select(document.claims, CorrectionClaim) if f"after {c.row} lost" in what)
        ends = np.concatenate([np.array(document.bounds(claim)), np.zeros((2, 2 * n + 1))], axis=1)
        whole = matrices.everything(system, corrections)
        return TaylorEnclosure(whole, ends[0], ends[1], np.zeros(ends.shape[1]), "smooth")
    joint = int(what.rpartition(" ")[2]) - 1 if what[-1].isdigit() else 0
    one = slice(joint, joint + 1)
    both = np.concatenate([inputs, speeds], axis=1)
    force, friction = matrices.input_force(model, n), matrices.friction(model, n)
    # A force that the model lacks may add to both.
    joint_force = _within(document, lambda y: force(y[:-n]) + friction(y[-n:]), 4, document.given.disturbance, one)
    slope = _within(document, matrices.friction_slopes(model, n), 5, chosen=one)
    kinds: dict[str, tuple[Any, np.ndarray, Literal["", "defined", "smooth"]]] = {
        "the bound of the input's force": (_within(document, force, 3), inputs, ""),
        "the definedness of the input's force": (force, inputs, "defined"),
        f"the bound of the force with friction {joint + 1}": (joint_force, both, ""),
        f"the bound of the friction's slope {joint + 1}": (slope, speeds, ""),
    }
    function, box, watch = kinds[what]
    return TaylorEnclosure(function, box[0], box[1], np.zeros(box.shape[1]), watch)


def predicted_values(document: Document, observer: Any) -> TaylorEnclosure:
    """Build the values of a prediction that must be defined and smooth."""
    low, high = document.bounds(select(document.claims, PredictionClaim)[0])
    values = step_values(matrices.prediction_of_steps(document, observer), jacobian)
    return TaylorEnclosure(values, low, high, np.zeros(len(low)), "smooth")


def need_sampled_box(document: Document, in_coordinates: bool) -> slice:
    """Check that the box contains all ages, and on rotations all entries of their matrices."""
    low, high, stop = document.low, document.high, document.forces.stop
    if document.sampling is None:
        return slice(0, stop)
    oldest = document.sampling.oldest
    if not (low[-1] <= 0 and oldest <= high[-1]):
        raise InputError(f"box: it must hold the ages from 0 to {oldest:.6g} s of measurements")
    entries = 0 if in_coordinates else document.first_velocity
    if not ((low[:entries] <= -1).all() and (high[:entries] >= 1).all()):
        raise InputError("box: it must hold all entries of rotations, from -1 to 1")
    return slice(entries, stop)


def need_sampled_rate_and_radius(document: Document) -> None:
    """Check that a positive rate remains, and that noise and unknown forces do not lead out of the radius."""
    assert document.sampling is not None
    rate, radius, loss = document.rate, document.radius, document.loss
    if not loss.allowed(rate):
        slower = f"{loss.rate:.6g} 1/s by the factor of the correction, up to {loss.restart:.6g} of a restart"
        raise InputError(f"rate: nothing is left of {rate / 2:.6g} 1/s, less {slower}")
    steps = document.drift
    if not steps < radius:
        count = document.sampling.substeps
        away = f"errors of {count} steps lead {steps:.6g} away, and the radius is {radius:.6g}"
        raise InputError(f"sampling.substeps: {away}")
    recursion = Recursion.of(document.sampling, document.q, rate, document.given, document.claims)
    if recursion.disturbed and not recursion.keeps(radius):
        farthest = recursion.largest(radius)
        raise InputError(f"radius: noise and disturbance lead out of {radius:.6g}, to {farthest:.6g}")
