"""Perturbs every operation of a graph by one random rounding, to show how rounding affects its results.

Each lane of a batch has its own random roundings, so that the results of the lanes differ as much as the conditioning
of the function causes. Two implementations of the function may differ by as much.

Source: Vignes 1993, A stochastic arithmetic for reliable scientific computation, Mathematics and Computers in
Simulation 35(3).
"""

import itertools

import numpy as np

from scalargraph.graph import FOLD, TRUTHS, Domain

EXACT = {"neg", "abs", "sign", "floor", "ceil", "round", "min", "max", "select", "either"}
"""Operations on numbers that do not round; operations with truth values as results do not round either."""
WHOLE = {"add", "sub", "mul"}
"""Operations that do not round if their result is an integer, such as a count."""

POOL = 4093
"""Number of random roundings that are drawn; they are used cyclically."""


def perturbed(unit: float, lanes: int, seed: int = 0) -> Domain:
    """Return an arithmetic on batches, for `evaluate`: lane 0 is exact to rounding, the others are perturbed randomly.

    Args:
        unit: Largest relative error of an operation: 2⁻⁵³ in double precision, 2⁻²⁴ in single precision.
        lanes: Number of lanes L; every value is an array (L,), or a scalar that all lanes share.
        seed: Seed of the random roundings.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> lowered = scalargraph.lower(lambda x: jnp.sin(x), jnp.array(0.0))
        >>> (values,) = scalargraph.evaluate(lowered, scalargraph.perturbed(2.0**-53, lanes=3), [1.0])
        >>> values.shape, bool((abs(values / values[0] - 1) <= 2.0**-52).all())
        ((3,), True)
    """
    # Lane 0 stays unperturbed, as the reference.
    away = np.arange(lanes) > 0
    pool = unit * np.random.default_rng(seed).uniform(-1.0, 1.0, (POOL, lanes)) * away
    turn = itertools.cycle(1.0 + pool)

    def rough(op: str):
        plain = FOLD[op]

        def whole_or_rounded(*arguments):
            value = plain(*arguments)
            # Sums and products of counts are exact, so they stay integers, which can serve as indices.
            return np.where(value == np.rint(value), value, value * next(turn))

        def rounded(*arguments):
            return plain(*arguments) * next(turn)

        return plain if op in EXACT | TRUTHS else whole_or_rounded if op in WHOLE else rounded

    # With a precision below double, constants of the code are rounded too.
    short = unit > 2.0**-50

    def constant(value):
        """The number; if single precision cannot hold it, it is perturbed like a result."""
        exact = isinstance(value, bool) or not short or not np.isfinite(value) or np.float32(value) == value
        return np.asarray(value) if exact else value * next(turn)

    return {"constant": constant, **{op: rough(op) for op in FOLD}}
