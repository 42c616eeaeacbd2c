"""The claims that a proof of contraction consists of, and the length that noise and disturbance add to the flow."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates.base._document import NUMBERS, STEPS, Document, Given, Kind, Stated, prediction_places
from covariant.certificates.base._noise import steady_distance
from covariant.certificates.base._radius_recursion import UNDISTURBED, Recursion
from covariant.certificates.base._sampling import Loss, Sampling
from covariant.proofs import Box, Proof, from_letters, to_letters


class Claim(NamedTuple):
    """One proved inequality of a certificate.

    Attributes:
        kind: "contraction": squared lengths decrease at the rate of the certificate. "reach": a curve of length ℓ
            changes the entry `row` of (error, velocity) by less than `ℓ √square`, which bounds the half width of the
            tube in that entry. "disturbance": errors of measurement and force, relative to their sizes and within the
            unit ball, add at most `√square` in length to the flow. "correction": the correction after `row` lost
            samples lengthens no curve, or with noise adds at most the sum of `squares` to its squared length.
            "prediction": the fourth derivative of the defect of Runge–Kutta steps, over 4!, is shorter than `√square`.
            "start": an error with components δ is at most `√(square Σ δ_i²/s_i)` long, with the squares s of the claims
            on reach. "missing": the acceleration that a prediction lacks is less than `√square` times the position
            error, whose length is at most `limit` times that of a curve.
        proof: the tree of boxes over which the inequality was shown.
        row: for "reach", the index of the entry of (error, velocity), from 0 to 2n − 1; for "correction", the number of
            samples lost before it.
        square: for "reach", "disturbance", "prediction" and "missing", the square of the bound; for "start" a factor.
        limit: for "reach", the largest half width that stays within the region, in the unit of the entry; for
            "missing", the bound of the length of the position error for a curve of unit length.
        squares: for "correction" with noise, what each measured position adds to a squared length.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates import Claim
        >>> from covariant.proofs import box, prove
        >>> proof = prove(lambda z: jnp.array([[2.0 - z[0]]]), box(v=(-1.0, 1.0)))
        >>> Claim("contraction", proof).document()["kind"], proof.verdict
        ('contraction', 'holds')
    """

    kind: Kind
    proof: Proof
    row: int = 0
    square: float = 0.0
    limit: float = 0.0
    squares: tuple[float, ...] = ()

    @property
    def stated(self) -> Stated:
        """The claim in the form in which a file states it."""
        return Stated(self.kind, tuple(to_letters(self.proof.levels)), self.row, self.square, self.limit, self.squares)

    def document(self) -> dict[str, Any]:
        """Convert the claim to data for the file.

        Returns:
            Its kind, the numbers that belong to this kind, and its tree of boxes with one string for each level.
        """
        numbers: dict[str, Any] = {key: getattr(self, key) for key in NUMBERS[self.kind]}
        numbers |= {"squares": list(self.squares)} if self.squares else {}
        return {"kind": self.kind, **numbers, "levels": to_letters(self.proof.levels)}


def stated_claims(document: Document, domain: Box) -> tuple[Claim, ...]:
    """Build the claims of a file, with the trees of boxes that it states as their proofs.

    Args:
        document: the parsed file.
        domain: the box of all its claims.

    Returns:
        One claim for each in the file, in the same order. Its proof is only stated, not verified.
    """
    return tuple(
        Claim(
            claim.kind,
            Proof.stated(bounds, from_letters(claim.levels)),
            claim.row,
            claim.square,
            claim.limit,
            claim.squares,
        )
        for claim, bounds in ((claim, _box_of(document, claim, domain)) for claim in document.claims)
    )


def _box_of(document: Document, claim: Stated, domain: Box) -> Box:
    low, high = document.bounds(claim)
    if claim.kind == "prediction":
        places = prediction_places(len(domain.low), len(document.velocity))
        names, units = (tuple(each[k] for k in places) for each in (domain.names, domain.units))
        return Box((*names, *STEPS), (*units, "s", "s"), low, high)
    return domain._replace(low=low, high=high)


def loss_of(sampling: Sampling | None, q: Float[np.ndarray, "2 2"], rate: float, claims: Sequence[Claim]) -> Loss:
    """Compute what the factor of the correction that runs takes from the rate.

    Args:
        sampling: when measurements come; None in continuous time.
        q: the matrix R_0 (2, 2).
        rate: rate λ of squared lengths [1/s].
        claims: the claims; without one of the kind "missing" nothing is known, and nothing subtracted.
    """
    bounds = [(claim.square, claim.limit) for claim in claims if claim.kind == "missing"]
    return Loss(0.0, 0.0) if sampling is None or not bounds else Loss.of(sampling, q, rate, *bounds[0])


def claimed_drift(sampling: Sampling | None, q: Float[np.ndarray, "2 2"], rate: float, claims: Sequence[Any]) -> float:
    """Compute the distance to which errors of Runge–Kutta steps alone may lead.

    Args:
        sampling: when measurements come; None in continuous time.
        q: the matrix R_0 (2, 2).
        rate: rate λ of squared lengths [1/s].
        claims: the claims; without one of the kind "prediction" nothing is known, and the distance is taken as 0.
    """
    return 0.0 if sampling is None else Recursion.of(sampling, q, rate, UNDISTURBED, claims).steady


def steady_of(
    sampling: Sampling | None,
    q: Float[np.ndarray, "2 2"],
    rate: float,
    given: dict[str, Any],
    claims: Sequence[Claim],
) -> float:
    """Compute the distance to which noise, disturbance and errors of predictions alone may lead.

    Args:
        sampling: when measurements come; None in continuous time.
        q: the matrix Q (2, 2), with samples R_0.
        rate: rate λ of squared lengths [1/s].
        given: the bounds of a certificate.
        claims: its claims.

    Returns:
        The distance, in the metric; 0 without all of these, ∞ where it is not proved.
    """
    if sampling is None:
        return steady_distance(rate, disturbance_length(given, claims))
    disturbed = any(given["noise"]) or any(given["disturbance"])
    if disturbed and sum(claim.kind == "correction" for claim in claims) <= sampling.lost:
        return math.inf
    return Recursion.of(sampling, q, rate, given, claims).steady


def disturbance_sizes(given: dict[str, Any]) -> Float[np.ndarray, "two_n"]:
    """Compute the largest errors of the measured position and of the force.

    The error of the force is the unmodelled force, plus the change of the force where it is evaluated at a position
    with an error. Together the errors lie in a ball of radius √m relative to these sizes, where m is the number of
    sizes that are not zero.

    Args:
        given: the bounds `noise` (n,), `disturbance` (n,) and `slopes` (n, n) of a certificate.

    Returns:
        Sizes (2n,): those of the measured position, then those of the force.
    """
    noise, unknown, slopes = (np.asarray(given[name], float) for name in ("noise", "disturbance", "slopes"))
    # Σ_j |∂f_i/∂q_j| · noise_j bounds the change of force i; the factor covers the rounding of this sum.
    induced = (np.reshape(slopes, (len(noise), -1)) * noise).sum(axis=1) * (1 + 1e-12)
    return np.concatenate([noise, unknown + induced])


def disturbance_length(given: dict[str, Any], claims: Sequence[Claim]) -> float:
    """Bound the length D that noise and disturbance add to the flow.

    Args:
        given: the bounds of a certificate, as for `disturbance_sizes`.
        claims: its claims, of which the one about the disturbance is used.

    Returns:
        D, in the metric; 0 where no noise and no disturbance are given, ∞ if the bound is not proved.
    """
    count = np.count_nonzero(disturbance_sizes(given))
    squares = [claim.square for claim in claims if claim.kind == "disturbance"]
    # The errors lie in a ball of radius √count, not in the unit ball of the claim; the factor covers rounding.
    return math.sqrt(count * squares[0]) * (1 + 1e-12) if squares else math.inf if count else 0.0


def read_bounds(plain: Mapping[str, Any]) -> Given:
    """Read the bounds of a certificate from plain data.

    Args:
        plain: the data of a file, as from `plain_bounds`.
    """
    sides = [np.array([plain[key]["low"], plain[key]["high"]], float) for key in ("positions", "inputs")]
    return Given(*sides, *(np.asarray(plain[key], float) for key in ("times", "noise", "disturbance", "slopes")))


def plain_bounds(given: Given) -> dict[str, Any]:
    """Convert the bounds of a certificate to data for the file.

    Args:
        given: bounds of positions, inputs, times, noise, disturbance and slopes.
    """

    def pair(bounds: np.ndarray) -> dict[str, list[float]]:
        return {"low": bounds[0].tolist(), "high": bounds[1].tolist()}

    rest = {key: getattr(given, key).tolist() for key in ("times", "noise", "disturbance", "slopes")}
    return {"positions": pair(given.positions), "inputs": pair(given.inputs), **rest}
