"""What rounding does to the results of a graph: its numbers, with every operation off by one rounding at random.

Lanes of a batch that see other roundings differ by what the function makes of them, its conditioning included: so much
may an implementation differ from another.

Source: Vignes 1993, A stochastic arithmetic for reliable scientific computation, Mathematics and Computers in
Simulation 35(3).
"""

import itertools

import numpy as np

from covariant.lowering._graph import FOLD, TRUTHS
from covariant.lowering._read import Domain

EXACT = {"neg", "abs", "sign", "floor", "ceil", "round", "min", "max", "select", "either"}
"""Operations on numbers that do not round; those that give truth values do not either."""
WHOLE = {"add", "sub", "mul"}
"""Operations that do not round where their result is a whole number, such as a count."""

POOL = 4093
"""Number of roundings that are drawn; they are used in turn."""


def perturbed(unit: float, lanes: int, seed: int = 0) -> Domain:
    """An arithmetic on arrays of so many lanes: lane 0 has the numbers, the others are off by `unit` at random.

    - `unit`: the largest relative error of an operation, 2⁻⁵³ in double precision.
    """
    away = np.arange(lanes) > 0
    pool = unit * np.random.default_rng(seed).uniform(-1.0, 1.0, (POOL, lanes)) * away
    turn = itertools.cycle(1.0 + pool)

    def rough(op: str):
        plain = FOLD[op]

        def whole_or_rounded(*arguments):
            value = plain(*arguments)
            return np.where(value == np.rint(value), value, value * next(turn))

        def rounded(*arguments):
            return plain(*arguments) * next(turn)

        return plain if op in EXACT | TRUTHS else whole_or_rounded if op in WHOLE else rounded

    short = unit > 2.0**-50

    def constant(value):
        """A number as it is or, where single precision cannot hold it, off as a result is."""
        exact = isinstance(value, bool) or not short or not np.isfinite(value) or np.float32(value) == value
        return np.asarray(value) if exact else value * next(turn)

    return {"constant": constant, **{op: rough(op) for op in FOLD}}
