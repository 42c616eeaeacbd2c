"""Proves from the graph of a function that it has no jumps."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from covariant.certificates.base._statement import Hypothesis
from scalargraph import LoweringError, lower
from scalargraph.proofs import Box, show_conditions

JUMPS = ("decided", "whole")
"""Kinds of conditions that exclude jumps."""
ANALYTIC = {
    *("input", "constant", "add", "sub", "neg", "mul", "div", "sin", "cos", "exp", "log", "sqrt", "atan", "stumpff"),
}
"""Operations that have derivatives of all orders wherever they are defined."""


def show_no_jumps(
    what: str, function: Callable, arguments: Sequence[np.ndarray], names: Sequence[str]
) -> tuple[Hypothesis, ...]:
    """Prove that a function does not jump between states (k, …), as a hypothesis; empty if its graph has no jumps."""
    try:
        conditions = lower(function, *(jnp.asarray(rows[0], float) for rows in arguments), real=True).conditions
    except LoweringError:  # then JAX differentiates it, and the derivatives are compared with differences of values
        return (Hypothesis(f"the derivatives of {what} are the slopes of its values at each of the states", "sampled"),)
    assert conditions is not None
    noted = conditions._replace(conditions=tuple(c for c in conditions.conditions if c.kind in JUMPS))
    if not noted.conditions:
        return ()
    rows = np.concatenate([np.reshape(part, (len(part), -1)) for part in arguments], axis=1)
    reason = show_conditions(noted, Box(tuple(names), ("",) * len(names), rows.min(0), rows.max(0)))
    text = f"{what} does not jump between the states"
    return (Hypothesis(text, "proved", "undecided" if reason else "holds", place=reason),)
