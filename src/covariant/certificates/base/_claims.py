"""Defines the kinds of claims in a proof of contraction, with the numbers, the file format and the text of each kind.

The matrix of a claim, which must be positive definite on a box, is formed twice and independently: by the prover as a
graph with its own derivatives (`FORMS`), and by the checker as a JAX function (`MATRICES`). Both are listed by kind.
`_radius_recursion` and the checker draw the conclusions from all claims together.
"""

import abc
import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np
from jaxtyping import Float

from covariant.certificates.base._assumed import PREDICTIONS, SMOOTH_FACTOR
from covariant.certificates.base._box import Given, prediction_places, prediction_variables
from covariant.certificates.base._sampling import Sampling
from covariant.certificates.base._statement import Evidence, Hypothesis, exact, rounded_up
from scalargraph.proofs import Box, Field, Proof, saved_levels, to_letters

Ends = tuple[np.ndarray, np.ndarray]
UNPROVED = Proof("undecided", Box((), (), np.zeros(0), np.zeros(0)), [], None, np.zeros((0, 2, 0)), 0, math.nan)
"""The proof of a claim that was not proved in this process."""


class Setting(NamedTuple):
    """The problem of a certificate, which determines the boxes and the numbers of its claims.

    Attributes:
        low, high: the box (d,); its last variable is the age if measurements are sampled.
        n: number of velocities.
        sampling: when measurements come; None in continuous time.
        given: the bounds of noise and forces.
        order: order of the observer in the error; None for an exact one.
    """

    low: Float[np.ndarray, "d"]
    high: Float[np.ndarray, "d"]
    n: int
    sampling: Sampling | None
    given: Given
    order: int | None


class Terms(NamedTuple):
    """Quantities that appear in the text of a claim.

    Attributes:
        rate: rate λ [1/s] of squared lengths.
        radius: radius of the tube; 0 if there is none.
        sampling: when measurements come; None in continuous time.
        entries: names (2n) of the entries of (error, velocity).
    """

    rate: float
    radius: float
    sampling: Sampling | None
    entries: Sequence[str]


@dataclasses.dataclass(frozen=True)
class AbstractClaim(abc.ABC):
    """One inequality of a certificate. Each kind adds its numbers as fields.

    A new kind needs a subclass here, listed in `CLAIMS` at its place in the file, a form for the prover, and a matrix
    for the checker. `read` and `document` follow from its fields.

    Attributes:
        proof: the tree of boxes over which it was shown; `UNPROVED` for a claim that was read from a file.
        letters: the tree as stated in a file, one string for each level.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.base import CLAIMS
        >>> from scalargraph.proofs import box, prove
        >>> proof = prove(lambda z: jnp.array([[2.0 - z[0]]]), box(v=(-1.0, 1.0)))
        >>> claim = CLAIMS["reach"](proof, row=0, square=4.0, limit=0.5)
        >>> claim.document()
        {'kind': 'reach', 'row': 0, 'square': 4.0, 'limit': 0.5, 'levels': ['.']}
    """

    proof: Proof
    _: dataclasses.KW_ONLY
    letters: tuple[str, ...] = ()

    kind: ClassVar[str]
    assumed_without: ClassVar[str] = ""
    """The assumption that a certificate with samples makes if it has no claim of this kind."""

    @classmethod
    @abc.abstractmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        """Return how many claims of this kind a certificate has, at least and at most."""

    @abc.abstractmethod
    def text(self, terms: Terms) -> str:
        """Return what is assumed if this claim is a hypothesis.

        Args:
            terms: the quantities that appear in the text.
        """

    def margin(self, radius: float) -> float | None:
        """Return the margin of the claim for a tube of a radius; None if the claim has no such number.

        Args:
            radius: the radius.
        """
        return None

    def bounds(self, low: np.ndarray, high: np.ndarray, n: int, sampling: Sampling | None) -> Ends:
        """Return the bounds of the box of this claim.

        Args:
            low, high: the box (d,) of the certificate.
            n: number of velocities.
            sampling: when measurements come; None in continuous time.
        """
        return low, high

    def variables(self, names: Sequence[str], units: Sequence[str], n: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return names and units of the variables of its box, from those of the certificate.

        Args:
            names: names (d).
            units: units (d).
            n: number of velocities.
        """
        return tuple(names), tuple(units)

    def hypothesis(self, terms: Terms, evidence: Evidence) -> Hypothesis:
        """Return this claim as a hypothesis of a statement.

        Args:
            terms: the quantities that appear in the text.
            evidence: "proved", or "claimed" by a file.
        """
        return Hypothesis(self.text(terms), evidence, self.proof.verdict, self.margin(terms.radius), self.proof.reason)

    @functools.cached_property
    def levels(self) -> tuple[str, ...]:
        """The tree of boxes, one string for each level."""
        return self.letters or tuple(to_letters(self.proof.levels))

    @property
    def open(self) -> bool:
        """Whether some boxes of the claim are undecided."""
        return any("?" in level for level in self.levels)

    def document(self) -> dict[str, Any]:
        """Convert the claim to data for the file.

        Returns:
            Its kind, its numbers, and its tree of boxes with one string for each level.
        """
        pairs = ((key, getattr(self, key)) for key in self._keys() if getattr(self, key) != self._defaults().get(key))
        numbers = {key: list(value) if isinstance(value, tuple) else value for key, value in pairs}
        return {"kind": self.kind, **numbers, "levels": list(self.levels)}

    @classmethod
    def read(cls, field: Field, index: int, setting: Setting) -> Self:
        """Read a claim of this kind from a file.

        Args:
            field: the claim in the file.
            index: number of earlier claims of this kind, which must equal the `row` of this one.
            setting: the problem of the certificate.

        Raises:
            ValueError: The claim is invalid; the message names file and key.
        """
        errors = int(np.count_nonzero(setting.given.noise))
        there = {"squares": errors > 0, "order": "order" in field.value}
        keys = [key for key in cls._keys() if there.get(key, True)]
        fields = field.record(["kind", *keys, "levels"])
        numbers: dict[str, Any] = {key: fields[key].positive() for key in keys if key not in ("row", *there)}
        if "row" in keys:
            numbers["row"] = fields["row"].whole(index, index)
        if "squares" in keys:
            squares = fields["squares"].vector(errors, errors, least=0.0)
            fields["squares"].need((squares > 0).all(), "positive numbers")
            numbers["squares"] = tuple(squares.tolist())
        if "order" in keys:
            numbers["order"] = fields["order"].whole(0, cls._defaults()["order"])
        claim = cls(UNPROVED, **numbers)
        low, _ = claim.bounds(setting.low, setting.high, setting.n, setting.sampling)
        return dataclasses.replace(claim, letters=saved_levels(fields["levels"], len(low)))

    @classmethod
    def _keys(cls) -> list[str]:
        """The names of the numbers of this kind."""
        return [field.name for field in dataclasses.fields(cls) if field.name not in ("proof", "letters")]

    @classmethod
    def _defaults(cls) -> dict[str, Any]:
        """Default values of the numbers that a file may omit."""
        return {field.name: field.default for field in dataclasses.fields(cls) if field.default != dataclasses.MISSING}


@dataclasses.dataclass(frozen=True)
class ContractionClaim(AbstractClaim):
    """Squared lengths decrease at the rate of the certificate."""

    kind = "contraction"

    @classmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        return 1, 1

    def text(self, terms: Terms) -> str:
        between = "" if terms.sampling is None else " between samples"
        return f"squared lengths shrink at {exact(terms.rate)} 1/s or faster{between} everywhere in the domain"


@dataclasses.dataclass(frozen=True)
class ReachClaim(AbstractClaim):
    """A curve of length ℓ changes the entry `row` of (error, velocity) by less than `ℓ √square`.

    Attributes:
        row: index of the entry, from 0 to 2n − 1.
        square: square of the bound.
        limit: the largest half width that stays within the region, in the unit of the entry.
    """

    row: int
    square: float
    limit: float

    kind = "reach"

    @classmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        return 2 * setting.n, 2 * setting.n

    def text(self, terms: Terms) -> str:
        return (
            f"a curve of the length of the radius reaches less than {self.limit:.4g} far in {terms.entries[self.row]}"
        )

    def margin(self, radius: float) -> float | None:
        return self.limit - radius * math.sqrt(self.square) if radius else None


@dataclasses.dataclass(frozen=True)
class RemainderClaim(AbstractClaim):
    """A tensor is at most `√square` long; from all of them follows how far observer (2) is from its approximation (5).

    Attributes:
        row: index of the tensor in `TENSORS`.
        square: square of the bound of |T(u, …)|, for unit vectors u in the metric.
    """

    row: int
    square: float

    kind = "remainder"
    TENSORS: ClassVar[tuple[str, ...]] = ("Γ(u, w)", "(∂Γ)(u, w, x)", "S", "R(u, v)v", "(∂R)(u, w, v)v")

    @classmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        count = len(cls.TENSORS) if setting.order is None else 0
        return count, count

    def text(self, terms: Terms) -> str:
        size = rounded_up(math.sqrt(self.square))
        return f"{self.TENSORS[self.row]} is at most {size} long, where u, w and x are 1 long"


@dataclasses.dataclass(frozen=True)
class DisturbanceClaim(AbstractClaim):
    """Errors of measurement and force, scaled to the unit ball by their bounds, add at most `√square` to the flow.

    Attributes:
        square: square of the bound on this addition; with samples, on the addition by the force alone.
    """

    square: float

    kind = "disturbance"

    @classmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        # In continuous time noise requires this claim too; the checker reports it if it is missing.
        acts = int(setting.given.disturbance.any())
        return (0, 1) if setting.sampling is None else (acts, acts)

    def text(self, terms: Terms) -> str:
        return "noise and unknown forces add no more to the flow than the radius allows"


@dataclasses.dataclass(frozen=True)
class CorrectionClaim(AbstractClaim):
    """The correction after `row` lost samples lengthens no curve.

    Attributes:
        row: number of samples lost before it.
        squares: with noise, for each measured position the largest amount that its error adds to a squared length.
    """

    row: int
    squares: tuple[float, ...] = ()

    kind = "correction"

    @classmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        count = 0 if setting.sampling is None else setting.sampling.lost + 1
        return count, count

    def text(self, terms: Terms) -> str:
        assert terms.sampling is not None
        first, last = (exact(h) for h in terms.sampling.ages[self.row])
        added = f", and its error adds at most {rounded_up(math.fsum(self.squares))} to a squared length"
        text = f"the correction by a measurement that is {first} to {last} s old lengthens no curve"
        return text + (added if self.squares else "")

    def bounds(self, low: np.ndarray, high: np.ndarray, n: int, sampling: Sampling | None) -> Ends:
        return _at_ages(low, high, sampling, self.row)


@dataclasses.dataclass(frozen=True)
class MissingClaim(AbstractClaim):
    """The acceleration that a prediction omits is less than `√square` times the position error.

    Attributes:
        square: square of the bound [1/s⁴].
        limit: bound of the length of the position error for a curve of unit length.
    """

    square: float
    limit: float

    kind = "missing"
    assumed_without = SMOOTH_FACTOR

    @classmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        # The claim bounds the factor of the correction; a correction of second order has no factor.
        count = int(setting.sampling is not None and setting.order == 1)
        return count, count

    def text(self, terms: Terms) -> str:
        return "the acceleration that a prediction lacks, and the position error, keep their bounds"

    def bounds(self, low: np.ndarray, high: np.ndarray, n: int, sampling: Sampling | None) -> Ends:
        return _at_ages(low, high, sampling, 0)


@dataclasses.dataclass(frozen=True)
class PredictionClaim(AbstractClaim):
    """The k-th derivative of the defect of Runge–Kutta steps, divided by k!, is shorter than `√square`.

    Hence the defect after a step of length s is at most `s^k √square`, and the step is off by `s^(k+1) √square/(k+1)`.

    Attributes:
        square: square of the bound.
        order: k, from 0 to the order of the steps. A low order helps with steep friction, whose high derivatives may
            be too large for a bound.
    """

    square: float
    order: int = 4

    kind = "prediction"
    assumed_without = PREDICTIONS

    @classmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        return 0, int(setting.sampling is not None and setting.sampling.substeps is not None)

    def text(self, terms: Terms) -> str:
        return "the defect of the Runge–Kutta steps of a prediction keeps its bound"

    def defect(self, longest: float) -> float:
        """Compute how much steps of at most this length [s] add to a distance per second [1/s]."""
        return longest**self.order * math.sqrt(self.square) / (self.order + 1)

    def bounds(self, low: np.ndarray, high: np.ndarray, n: int, sampling: Sampling | None) -> Ends:
        # A prediction has two step lengths as variables instead of errors, joint forces and slopes.
        assert sampling is not None
        places, longest = prediction_places(len(low), n), sampling.longest_step
        return np.append(low[places], [0.0, 0.0]), np.append(high[places], [longest, longest])

    def variables(self, names: Sequence[str], units: Sequence[str], n: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
        return prediction_variables(names, units, n)


@dataclasses.dataclass(frozen=True)
class StartClaim(AbstractClaim):
    """An error with components δ has at most the length `√(square Σ δ_i²/s_i)`, with s the squares of the reach claims.

    Attributes:
        square: the factor.
    """

    square: float

    kind = "start"

    @classmethod
    def count(cls, setting: Setting) -> tuple[int, int]:
        return 0, 1

    def text(self, terms: Terms) -> str:
        return "errors within the bounds of a start are no longer than the radius"


CLAIMS: dict[str, type[AbstractClaim]] = {
    "contraction": ContractionClaim,
    "reach": ReachClaim,
    "remainder": RemainderClaim,
    "disturbance": DisturbanceClaim,
    "correction": CorrectionClaim,
    "missing": MissingClaim,
    "prediction": PredictionClaim,
    "start": StartClaim,
}
"""The kinds of claims, in the order in which a file lists them."""

AnyClaim = TypeVar("AnyClaim", bound=AbstractClaim)


def select(claims: Sequence[AbstractClaim], kind: type[AnyClaim]) -> list[AnyClaim]:
    """Return the claims of one kind."""
    return [claim for claim in claims if isinstance(claim, kind)]


def reach_squares(claims: Sequence[AbstractClaim]) -> Float[np.ndarray, "two_n"]:
    """Return the squares (2n,) of the claims on reach, positions first."""
    return np.array([claim.square for claim in select(claims, ReachClaim)])


def _at_ages(low: np.ndarray, high: np.ndarray, sampling: Sampling | None, lost: int) -> Ends:
    """The box for the ages of a measurement after a number of lost samples."""
    assert sampling is not None
    first, last = sampling.ages[lost]
    return np.append(low[:-1], first), np.append(high[:-1], last)
