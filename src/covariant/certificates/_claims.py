"""The claims that a proof of contraction consists of, and what noise and disturbance add to the flow."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates._document import NUMBERS, Document, Given, Kind, Stated
from covariant.proofs import Box, Proof, from_letters, to_letters


class Claim(NamedTuple):
    """One proved inequality.

    `kind` is one of
    - "contraction": squared lengths decrease at the rate of the certificate.
    - "reach": a curve of length ℓ changes the entry `row` of (error, velocity) by less than `ℓ √square`. This bounds
      the half width of the tube in that entry, which may be up to `limit`.
    - "disturbance": errors of measurement and force, relative to their sizes and within the unit ball, add at most
      `√square` in length to the flow.
    """

    kind: Kind
    proof: Proof
    row: int = 0
    square: float = 0.0
    limit: float = 0.0

    @property
    def stated(self) -> Stated:
        """The claim as a file states it."""
        return Stated(self.kind, tuple(to_letters(self.proof.levels)), self.row, self.square, self.limit)

    def document(self) -> dict[str, Any]:
        """The claim as data for the file."""
        numbers = {key: getattr(self, key) for key in NUMBERS[self.kind]}
        return {"kind": self.kind, **numbers, "levels": to_letters(self.proof.levels)}


def stated_claims(document: Document, domain: Box) -> tuple[Claim, ...]:
    """The claims of a file, with the trees of boxes that it states as their proofs."""
    return tuple(
        Claim(said.kind, Proof.stated(domain, from_letters(said.levels)), said.row, said.square, said.limit)
        for said in document.claims
    )


def disturbance_sizes(given: dict[str, Any]) -> Float[np.ndarray, "two_n"]:
    """Largest errors of the measured position, and of the force, unmodelled or evaluated at a wrong position (2n,).

    Together they lie in a ball of radius √m relative to these sizes, m being the number of sizes that are not zero.
    """
    noise, unknown, slopes = (np.asarray(given[name], float) for name in ("noise", "disturbance", "slopes"))
    through = (np.reshape(slopes, (len(noise), -1)) * noise).sum(axis=1) * (1 + 1e-12)
    return np.concatenate([noise, unknown + through])


def disturbance_length(given: dict[str, Any], claims: Sequence[Claim]) -> float:
    """D: the largest length that noise and disturbance add to the flow; 0 where none are given, ∞ if not proved."""
    count = np.count_nonzero(disturbance_sizes(given))
    squares = [claim.square for claim in claims if claim.kind == "disturbance"]
    return math.sqrt(count * squares[0]) * (1 + 1e-12) if squares else math.inf if count else 0.0


def read_bounds(plain: Mapping[str, Any]) -> Given:
    """The bounds of which a file has the data."""
    sides = [np.array([plain[key]["low"], plain[key]["high"]], float) for key in ("positions", "inputs")]
    return Given(*sides, *(np.asarray(plain[key], float) for key in ("times", "noise", "disturbance", "slopes")))


def plain_bounds(given: Given) -> dict[str, Any]:
    """The given bounds as data for the file."""

    def pair(bounds: np.ndarray) -> dict[str, list[float]]:
        return {"low": bounds[0].tolist(), "high": bounds[1].tolist()}

    rest = {key: getattr(given, key).tolist() for key in ("times", "noise", "disturbance", "slopes")}
    return {"positions": pair(given.positions), "inputs": pair(given.inputs), **rest}
