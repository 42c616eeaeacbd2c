"""Numbers that machines share in a fit, though the logs of one of them contradict it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from covariant.calibration._least_squares import ROUNDING, block_covariance

NumpyArray = np.ndarray

CONTRADICTION = 4.0
"""Standard errors by which the logs of one machine must contradict a shared number before it is said."""
LEAST_FREE = 4
"""Blocks that a machine has at least beside those that its numbers take, before it can contradict."""


class Evidence(NamedTuple):
    """What each of B blocks of logs says of the k unknowns of its machine: slopes and curvature of its loss."""

    machine: Int[NumpyArray, "B"]
    scores: Float[NumpyArray, "B k"]
    information: Float[NumpyArray, "B k k"]


def contradictions(
    names: tuple[str, ...],
    parts: Int[NumpyArray, "M k"],
    values: Float[NumpyArray, "p"],
    slopes: Float[NumpyArray, "p p"],
    evidence: Evidence,
    inverse: Float[NumpyArray, "p p"],
) -> tuple[str, ...]:
    """Sentences on shared numbers that one machine alone would have otherwise, by the next step of its own search.

    `slopes` are those of the values in the unknowns, and `inverse` is the covariance of these for independent errors.
    """
    shared = [j for j in range(len(values)) if (parts == j).any(axis=1).all()]
    if not shared or len(shared) == parts.shape[1]:  # of one machine, or with nothing of their own
        return ()
    changes, own, left = zip(*(_alone(evidence, machine) for machine in range(len(parts))), strict=True)
    # Errors that the numbers of each machine leave: what it contradicts is no noise.
    scores, curvature = np.zeros((len(evidence.machine), len(values))), np.zeros_like(inverse)
    for machine, part in enumerate(parts):
        here = evidence.machine == machine
        scores[np.ix_(here, part)] = left[machine]
        curvature[np.ix_(part, part)] += np.sum(evidence.information[here], axis=0)
    joint = block_covariance(scores, curvature, inverse)
    sentences = []
    for machine, part in enumerate(parts):
        if len(left[machine]) < len(part) + LEAST_FREE:
            continue
        slope = slopes[np.ix_(part, part)]
        change = slope @ changes[machine]
        both = own[machine] + joint[np.ix_(part, part)]
        error = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slope, both, slope), 0.0))
        name = next(names[j].partition("@")[2] for j in part if j not in shared)
        sentences += [
            f"{names[j]} is shared, but the logs of {name} alone change it by {change[k]:+.2g} ± {error[k]:.1g} from "
            f"{values[j]:.4g}: let each machine have its own, or look for another number in which this machine differs"
            for k, j in enumerate(part)
            if j in shared and abs(change[k]) > CONTRADICTION * error[k]
        ]
    return tuple(sentences)


def _alone(evidence: Evidence, machine: int) -> tuple[NumpyArray, NumpyArray, NumpyArray]:
    """The step (k,) of a search on the logs of one machine, its covariance, and the scores (B, k) after it."""
    here = evidence.machine == machine
    scores, information = evidence.scores[here], evidence.information[here]
    whole = np.sum(information, axis=0)
    size, axes = np.linalg.eigh(whole)
    known = axes[:, size > ROUNDING * size[-1]]
    inverse = known @ np.linalg.inv(known.T @ whole @ known) @ known.T
    change = -inverse @ np.sum(scores, axis=0)
    left = scores + information @ change
    return change, block_covariance(left, whole, inverse), left
