"""Which combinations of a robot's numbers a log determines: the pivots of its regressor, and their rows."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from covariant.calibration._least_squares import reduced_rows
from covariant.models import RobotFamily

SMALL = 0.01
"""Part of a combination, relative to its largest one in the usual sizes of the numbers, below which it is not named."""
ALIKE = 1e-3
"""Relative distance to a whole number at which a factor is rounded to it."""
LATE, CORRELATED = ("damping", "back_emf"), 0.9
"""Numbers that make a servo late as a delay does, and correlation of the errors from which logs hardly separate two."""


class Combinations(NamedTuple):
    """What a log determines of numbers that it cannot tell apart.

    Attributes:
        determined: Combinations of two or more numbers, as "inertia.upper.Iyy + 0.09 inertia.lower.mass".
        absorbed: Numbers that appear only in combinations, or not at all: as base parameters they are redundant.
        rank: Number of combinations and single numbers that the log determines.
        leading: First number of each combination.

    Example:
        >>> from covariant.calibration.identification import Combinations
        >>> Combinations(("armature.elbow + inertia.lower.Iyy",), ("inertia.lower.Iyy",), 5).rank
        5
    """

    determined: tuple[str, ...]
    absorbed: tuple[str, ...]
    rank: int
    leading: tuple[str, ...] = ()


def combinations(
    family: RobotFamily,
    information: Float[np.ndarray, "p p"],
    to_linear: Float[np.ndarray, "p p"],
    prior: Float[np.ndarray, "p"],
    known: float,
) -> Combinations:
    """Combinations that a log determines."""
    back = np.linalg.inv(to_linear)
    size = np.sqrt(np.sum((to_linear * prior) ** 2, axis=1))
    # A square root of the information is as good as the regressor itself: it has the same triangular factor.
    values, vectors = np.linalg.eigh(information)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    independent, dependent, factors = reduced_rows(root @ back * size, 1 / known)
    names = family.linear_names
    sentences, leading = [], []
    for row, i in sorted(zip(factors, independent, strict=True), key=lambda pair: pair[1]):
        parts = [(names[j], f * size[i] / size[j]) for f, j in zip(row, dependent, strict=True) if abs(f) > SMALL]
        if parts:
            sentences.append(names[i] + "".join(_term(name, factor) for name, factor in parts))
            leading.append(names[i])
    return Combinations(tuple(sentences), tuple(names[i] for i in sorted(dependent)), len(independent), tuple(leading))


def _term(name: str, factor: float) -> str:
    size = abs(factor)
    whole = round(size) or size
    size = whole if abs(size - whole) < ALIKE * whole else size
    return f" {'-' if factor < 0 else '+'} {name if size == 1 else f'{size:.3g} {name}'}"


def late_alike(family: RobotFamily, x: np.ndarray, covariance: np.ndarray) -> tuple[tuple[str, str, float], ...]:
    """Delays of servos and dampings whose errors are correlated: slow motion shows little but the lag of both."""
    slopes = np.asarray(jax.jit(jax.jacfwd(family.values))(x))
    at = {(number.target, number.number): i for i, number in enumerate(family.numbers) if number.group == "servo"}
    values, found = np.asarray(family.values(x)), []
    for (target, _), i in ((key, i) for key, i in at.items() if key[1] == "delay"):
        for j in (at[target, damping] for damping in LATE if (target, damping) in at):
            # Without weight all torques scale together, so that a damping counts relative to its stiffness.
            k, lag = at.get((target, "stiffness"), j), slopes[j]
            lag = lag - values[j] / values[k] * slopes[k] if k != j else lag
            pair = np.stack([slopes[i], lag])
            (late, both), (_, lagging) = pair @ covariance @ pair.T
            correlation = float(both / np.sqrt(late * lagging))
            found += [(family.names[i], family.names[j], correlation)] * bool(abs(correlation) > CORRELATED)
    return tuple(found)
