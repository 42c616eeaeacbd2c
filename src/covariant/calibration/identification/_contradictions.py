"""Numbers that machines share in a fit, though the logs of one of them contradict it."""

import jax
import numpy as np
from jaxtyping import Float

from covariant.calibration._least_squares import ROUNDING, Blocks, block_covariance
from covariant.calibration.identification._windows import Windows
from covariant.models import Family

NumpyArray = np.ndarray

CONTRADICTION = 4.0
"""Standard errors by which the logs of one machine must contradict a shared number before it is said."""
LEAST_FREE = 4
"""Windows that a machine has at least beside those that its numbers take, before it can contradict."""


def contradictions(
    family: Family,
    windows: Windows,
    blocks: Blocks,
    values: NumpyArray,
    slopes: NumpyArray,
    fixed: Float[NumpyArray, "p p"],
) -> tuple[str, ...]:
    """Sentences on shared numbers that one machine alone would have otherwise, by the next step of its own search.

    `slopes` (p,) are those of the values in the unknowns, and `fixed` projects on combinations that are not determined.
    """
    sentences, parts = [], np.asarray(family.parts)
    shared = [j for j in range(len(values)) if (parts == j).any(axis=1).all()]
    if not shared or len(shared) == parts.shape[1]:  # of one machine, or with nothing of their own
        return ()
    machines = np.asarray(windows.machine)
    # Scores around the mean of their machine, which is the contradiction itself.
    centred = np.array(blocks.z)
    for machine in np.unique(machines):
        centred[machines == machine] -= centred[machines == machine].mean(axis=0)
    joint = block_covariance(centred, blocks.information, blocks.inverse(fixed))
    for machine, part in enumerate(parts):
        here = machines == machine
        if np.sum(here) < parts.shape[1] + LEAST_FREE:
            continue
        mine = jax.tree.map(lambda leaf, here=here: np.asarray(leaf)[here], blocks._replace(rest=None))
        information = mine.information[np.ix_(part, part)]
        size, axes = np.linalg.eigh(information)
        told = axes[:, size > ROUNDING * size[-1]]
        inverse = told @ np.linalg.inv(told.T @ information @ told) @ told.T
        change = -inverse @ mine.z[:, part].sum(axis=0)
        own = block_covariance(centred[np.ix_(here, part)], information, inverse)
        error = np.sqrt(np.maximum(np.diagonal(own), 0.0) + np.maximum(np.diagonal(joint)[part], 0.0))
        name = next(family.names[j].partition("@")[2] for j in part if j not in shared)
        sentences += [
            f"{family.names[j]} is shared, but the logs of {name} alone change it by {change[k] * slopes[j]:+.2g} "
            f"± {error[k] * abs(slopes[j]):.1g} from {values[j]:.4g}: let each machine have its own, or look for "
            "another number in which this machine differs"
            for k, j in enumerate(part)
            if j in shared and abs(change[k]) > CONTRADICTION * error[k]
        ]
    return tuple(sentences)
