"""Proves which initial errors lie within the radius of a certificate: how long errors are in the metric."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates.base._claims import UNPROVED, AbstractClaim, StartClaim, reach_squares, select
from covariant.certificates.base._effort import Effort
from covariant.certificates.base._error_system import ErrorSystem
from covariant.certificates.base._inequalities import start_bound
from covariant.models import MechanicalSystem
from scalargraph import numbers
from scalargraph.proofs import Box, Form

MARGIN = 1.05
"""Margin on the sampled factor, so that it can be proved quickly."""
POINTS, TRIES = 2000, 4
"""Number of points at which the factor is sampled, and number of further tries if a point of the box is worse."""
ROUND = 1e-8
"""Relative margin for rounding."""
LEAST = 1e-290
"""Smallest size of a number that is printed with digits."""
BOXES = 20_000
"""Largest number of boxes for this claim, without which a certificate is still valid."""


class Start(NamedTuple):
    """Initial errors of an estimate that are within the radius of a certificate.

    Attributes:
        names: names of the positions, then of the velocities (2n).
        units: their units.
        together: errors (2n,) that all entries may have at once: every estimate in this box is within the radius.
        alone: errors (2n,) that one entry may have if the others have none.
        farthest: no estimate within the radius has a larger error (2n,).

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import Start
        >>> start = Start(("q", "v_q"), ("rad", "rad/s"), *np.array([[0.01, 0.1], [0.02, 0.2], [0.03, 0.3]]))
        >>> str(start)
        'q 0.572° (1.14° alone, never more than 1.72°), v_q 0.1 rad/s (0.2 rad/s alone, never more than 0.3 rad/s)'
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    together: Float[np.ndarray, "two_n"]
    alone: Float[np.ndarray, "two_n"]
    farthest: Float[np.ndarray, "two_n"]

    @property
    def lines(self) -> tuple[str, ...]:
        """One line for each entry, angles in degrees; the covered errors are rounded down."""
        return tuple(_line(*entry) for entry in zip(*self, strict=True))

    def __str__(self) -> str:
        return ", ".join(self.lines)


def _line(name: str, unit: str, *errors: float) -> str:
    together, alone, farthest = (math.degrees(error) if unit == "rad" else error for error in errors)
    sign = "°" if unit == "rad" else f" {unit}".rstrip()
    return f"{name} {_down(together)}{sign} ({_down(alone)}{sign} alone, never more than {-_down(-farthest):g}{sign})"


def _down(value: float) -> float:
    """Round a number down to three digits."""
    if not value or not math.isfinite(value):
        return value
    if abs(value) < LEAST:
        return min(value, 0.0)
    digits = 2 - math.floor(math.log10(abs(value)))
    # A value that already has three digits must not lose one by rounding.
    return round(math.floor(value * 10.0**digits * (1 - math.copysign(1e-13, value)) + 1e-9) / 10.0**digits, digits)


def start_of(radius: float, domain: Box, claims: Sequence[AbstractClaim]) -> Start | None:
    """Compute the initial errors that a radius covers."""
    proved, squares = select(claims, StartClaim), reach_squares(claims)
    if not proved:
        return None
    # An error δ has at most the length √(square Σ δ_i²/s_i), with squares s; here all 2n entries get an equal share.
    farthest = radius * np.sqrt(squares)
    # Rounded down, so that an estimate at these bounds is within the radius despite rounding.
    alone = farthest / math.sqrt(proved[0].square) * (1 - ROUND)
    count = len(squares)
    return Start(domain.names[:count], domain.units[:count], alone / math.sqrt(count), alone, farthest)


def start_claim(
    model: MechanicalSystem, system: ErrorSystem, claims: Sequence[AbstractClaim], effort: Effort
) -> list[StartClaim]:
    """Prove an upper bound of the length of errors, given in coordinates."""
    if not model.manifold.commuting or any(claim.proof.verdict != "holds" for claim in claims):
        return []
    squares, domain = reach_squares(claims), effort.domain
    share = np.random.default_rng(0).uniform(size=(POINTS, len(domain.low)))
    share[::2] = np.round(share[::2])
    graph = start_bound(system, squares, 0.0).graph(jnp.asarray(domain.high)).entries
    values = np.asarray(numbers(graph, domain.low + share * (domain.high - domain.low)))
    scale = np.sqrt(squares)
    # With the factor 0 the matrix is −M.
    metric = -values.reshape(-1, len(squares), len(squares)) * np.outer(scale, scale)
    square = MARGIN * float(np.linalg.eigvalsh(metric)[:, -1].max())
    little = dataclasses.replace(effort, boxes=min(effort.boxes, BOXES))

    def matrix(claim: StartClaim) -> Form:
        return start_bound(system, squares, claim.square)

    def longer(claim: StartClaim, point: np.ndarray) -> StartClaim:
        return dataclasses.replace(claim, square=claim.square * MARGIN**2)

    claim = little.prove_claim("a start", StartClaim(UNPROVED, square), matrix, longer, TRIES)
    effort.boxes -= min(effort.boxes, BOXES) - little.boxes
    return [claim] if claim.proof.verdict == "holds" else []
