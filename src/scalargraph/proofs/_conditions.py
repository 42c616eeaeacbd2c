"""Proves that a function is defined and does not jump on a box, by showing its conditions and halving the box."""

import itertools

import numpy as np

from scalargraph import Conditions, fulfilled
from scalargraph.graph import LARGEST
from scalargraph.proofs._box import Box
from scalargraph.proofs._tree import halves, middle_of

MOST_CONDITIONS, DEEPEST = 4096, 40
"""Largest number of boxes, and of halvings of a box, in a proof of conditions; three halvings suffice for most."""
MEANING = {"true": "is not shown to be defined", "finite": f"of numbers that are not shown to stay below {LARGEST:g}"}
"""Meaning of a condition that is not shown, by its kind."""
CENTRES, FINEST = 16, 8
"""Number of points at which the needed halvings of each single input are tested, and the most halvings tested."""


def show_conditions(conditions: Conditions, domain: Box) -> str:
    """Show by halving that all conditions hold over a box.

    A condition that holds on a box is not tested again on its parts.

    Args:
        conditions: Conditions on the variables of the box, as of a `Form`.
        domain: Bounds of these variables; those with an empty name are left out of the message.

    Returns:
        "" if all hold, or a text that names a condition that is not shown, and where.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.proofs import as_form, box, show_conditions
        >>> root = as_form(lambda z: jnp.sqrt(z)[:, None]).graph(jnp.zeros(1))
        >>> show_conditions(root.conditions, box(a=(1.0, 2.0)))
        ''
        >>> "is not shown to be defined where a is" in show_conditions(root.conditions, box(a=(-1.0, 2.0)))
        True
    """
    count, width = len(conditions.conditions), domain.high - domain.low
    low, high, undecided = domain.low[None], domain.high[None], np.ones((1, count), bool)
    if not count:
        return ""
    reads = _reads(conditions)
    needs = np.zeros(0)
    for depth in itertools.count():
        undecided &= ~fulfilled(conditions, low, high)
        unfinished = undecided.any(axis=1)
        if not unfinished.any():
            return ""
        if not needs.size:  # most conditions are shown on the whole box
            needs = _needed_halvings(conditions, domain, reads)
        # Only boxes with open conditions go on to the next depth.
        low, high, undecided = low[unfinished], high[unfinished], undecided[unfinished]
        relative = (high - low) / np.where(width > 0, width, 1.0) * (undecided[:, :, None] * needs).max(axis=1)
        middle = middle_of(low, high)
        # If the ends of a side are adjacent floats, no number lies between them, and the side cannot be halved.
        relative = np.where((middle > low) & (middle < high), relative, 0.0)
        stuck = np.flatnonzero(relative.max(axis=1) <= 0)
        # Halving doubles the number of boxes, so the next depth would exceed the number allowed.
        if len(stuck) or depth >= DEEPEST or 2 * len(low) > MOST_CONDITIONS:
            k = int(stuck[0]) if len(stuck) else 0
            condition = conditions.conditions[int(undecided[k].argmax())]
            where = [i for i in np.flatnonzero(reads[undecided[k].argmax()]) if domain.names[i]]
            region = ", ".join(f"{domain.names[i]} is {low[k, i]:.6g} to {high[k, i]:.6g}" for i in where)
            meaning = MEANING.get(condition.kind, "may jump")
            return f"{condition.because} {meaning}" + (f" where {region}" if region else "")
        axes = relative.argmax(axis=1)
        low, high = halves(low, high, axes)
        undecided = np.repeat(undecided, 2, axis=0)
    raise AssertionError


def _needed_halvings(conditions: Conditions, domain: Box, reads: np.ndarray) -> np.ndarray:
    """2ᵏ, if an input alone must be halved k times to show a condition (conditions, inputs); 0 if it is not read.

    The other inputs are points meanwhile. This only guides the search: inputs that matter most are halved first.
    """
    # The seed is fixed, so that equal proofs halve equal boxes; the points only affect the order of the halvings.
    shares = np.random.default_rng(0).uniform(size=(CENTRES, len(domain.low)))
    points = domain.low * (1 - shares) + domain.high * shares  # a difference of the ends may overflow
    needed = reads.copy()
    for i in np.flatnonzero(reads.any(axis=0)):
        for k in range(FINEST):
            # The interval around a point is as wide as a box after k halvings of this input.
            half = (domain.high[i] - domain.low[i]) / 2 ** (k + 1)
            low, high = points.copy(), points.copy()
            low[:, i] = np.maximum(domain.low[i], points[:, i] - half)
            high[:, i] = np.minimum(domain.high[i], points[:, i] + half)
            open_ = ~fulfilled(conditions, low, high).all(axis=0) & (reads[:, i] > 0)
            if not open_.any():
                break
            needed[open_, i] = 2.0 ** (k + 1)
    return needed


def _reads(conditions: Conditions) -> np.ndarray:
    """The inputs that each condition depends on, as a mask (conditions, inputs)."""
    nodes = conditions.graph.nodes
    read = np.zeros((len(nodes), conditions.inputs), bool)
    for i, node in enumerate(nodes):
        if node.op == "input":
            read[i, int(node.value or 0)] = True
        for a in node.arguments:
            read[i] |= read[a]
    return read[[c.node for c in conditions.conditions]].astype(float)
