"""An arithmetic in which every operation is off by one rounding at random, to see what rounding does to results.

The lanes of a batch get other roundings, so that their results differ by the conditioning of the function: two
implementations of it may differ by as much.

Source: Vignes 1993, A stochastic arithmetic for reliable scientific computation, Mathematics and Computers in
Simulation 35(3).
"""

import itertools

import numpy as np

from scalargraph.graph import FOLD, TRUTHS, Domain

EXACT = {"neg", "abs", "sign", "floor", "ceil", "round", "min", "max", "select", "either"}
"""Operations on numbers that do not round; those that give truth values do not either."""
WHOLE = {"add", "sub", "mul"}
"""Operations that do not round where their result is a whole number, such as a count."""

POOL = 4093
"""Number of roundings that are drawn; they are used in turn."""


def perturbed(unit: float, lanes: int, seed: int = 0) -> Domain:
    """Return an arithmetic on batches, for `evaluate`: lane 0 has the numbers, the others are perturbed at random.

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
            # Sums and products of counts are exact, and stay whole numbers that can index.
            return np.where(value == np.rint(value), value, value * next(turn))

        def rounded(*arguments):
            return plain(*arguments) * next(turn)

        return plain if op in EXACT | TRUTHS else whole_or_rounded if op in WHOLE else rounded

    # Coarser than double precision: constants of the code are rounded too.
    short = unit > 2.0**-50

    def constant(value):
        """A number as it is or, where single precision cannot hold it, off as a result is."""
        exact = isinstance(value, bool) or not short or not np.isfinite(value) or np.float32(value) == value
        return np.asarray(value) if exact else value * next(turn)

    return {"constant": constant, **{op: rough(op) for op in FOLD}}
