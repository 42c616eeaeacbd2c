"""Proved contraction of an intrinsic observer on a region: the statement and its claims, to be saved and read."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates._certificate import Certificate
from covariant.certificates._check import follows
from covariant.certificates._document import FORMAT, NUMBERS, Given, Kind, parse, write
from covariant.certificates._intrinsic import Intrinsics
from covariant.certificates._noise import steady_distance
from covariant.certificates._saved import observer_document, value_graph
from covariant.certificates._subject import Subject
from covariant.certificates._tangent_metric import TwoByTwo
from covariant.proofs import Box, Proof, digest, from_letters, to_letters


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

    def document(self) -> dict[str, Any]:
        """The claim as data for the file."""
        numbers = {key: getattr(self, key) for key in NUMBERS[self.kind]}
        return {"kind": self.kind, **numbers, "levels": to_letters(self.proof.levels)}


class ContractionCertificate(NamedTuple):
    """Result of a proof about an observer on a region.

    - `summary`: the statement, its verdict, and its margin, the rate λ [1/s] of squared lengths.
    - `rate`: λ [1/s]; `radius`: ε, in the metric of Q on states; 0 unless the verdict is "holds".
    - `observer`, `q` (2, 2): the observer, and the matrix Q of the metric; `subject`: both as functions of a box.
    - `domain`: the box of estimate, error and force; `velocity` (n,): the bound of the true velocity.
    - `given`: positions, inputs and times from which the bounds of the force follow; `noise`, `disturbance`, `slopes`.
    - `claims`: the inequalities, with their proofs.
    - `recipe`: where the model comes from, as from `models.recipe`; None for a model that only this process knows.
    - `verified`: whether it was proved in this process. A certificate that was read from a file is only as trustworthy
      as the file, until `covariant certify --check` has verified it.
    """

    summary: Certificate
    rate: float
    radius: float
    observer: Intrinsics
    q: TwoByTwo
    subject: Subject
    domain: Box
    velocity: Float[np.ndarray, "n"]
    given: dict[str, Any]
    claims: tuple[Claim, ...]
    recipe: dict[str, Any] | None
    verified: bool = False

    @property
    def decay(self) -> float:
        """μ [1/s]: distances decrease as `e^(−μt)`, at half the rate."""
        return self.rate / 2

    @property
    def steady(self) -> float:
        """The final distance under the noise and disturbance of the certificate, at most `2D/λ`; 0 without them."""
        return steady_distance(self.rate, disturbance_length(self.given, self.claims))

    @property
    def boxes(self) -> int:
        """Number of boxes evaluated."""
        return sum(claim.proof.boxes for claim in self.claims)

    @property
    def seconds(self) -> float:
        """Time of the proofs [s]."""
        return sum(claim.proof.seconds for claim in self.claims)

    @property
    def counterexample(self) -> Float[np.ndarray, "2 d"] | None:
        """A box on which the statement was proved wrong, or None."""
        return next((c.proof.counterexample for c in self.claims if c.proof.counterexample is not None), None)

    @property
    def half_widths(self) -> Float[np.ndarray, "two_n"]:
        """Half widths of the proved tube in each position error [unit], then in each velocity error [unit/s].
        Raises `ValueError` where no tube is proved.
        """
        if self.summary.verdict != "holds":
            raise ValueError("no tube, since nothing is proved on the region")
        return self.radius * np.sqrt([claim.square for claim in self.claims if claim.kind == "reach"])

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kind of each variable of the domain: "estimate", "velocity" (estimated), "error" or "force"."""
        n = len(self.velocity)
        words = ("estimate", "velocity", "error", "force")
        parts = words if len(self.domain.low) == 4 * n else words[1:]
        return tuple(word for word in parts for _ in range(n))

    @property
    def open(self) -> Float[np.ndarray, "k 2 d"]:
        """Boxes that were left undecided."""
        return np.concatenate([claim.proof.open for claim in self.claims])

    def document(self) -> dict[str, Any]:
        """The certificate as data for the file.

        Raises `ValueError` where the model has no recipe, and for a statement that was proved wrong.
        """
        if self.recipe is None:
            raise ValueError("a certificate is saved with its model; give certify(..., recipe=models.recipe(spec))")
        if self.summary.verdict == "undecided" and not len(self.open):
            raise ValueError(f"nothing is proved that could be saved: {self.summary.statement}")
        if self.counterexample is not None:
            raise ValueError("the statement is wrong, and a counter-example is printed, not saved; certify another one")
        found = {
            "format": FORMAT,
            "recipe": {"parameters": {}} | self.recipe,
            "observer": observer_document(self.observer),
            "q": self.q.tolist(),
            "rate": self.rate,
            "radius": self.radius,
            "velocity": self.velocity.tolist(),
            "given": self.given,
            "box": {"low": self.domain.low.tolist(), "high": self.domain.high.tolist()},
            "claims": [claim.document() for claim in self.claims],
            "graph": value_graph(self.subject),
        }
        return found | {"digest": digest(found)}

    def save(self, path: str | Path) -> Path:
        """Write the certificate with all its boxes as JSON, as data that executes nothing when it is read.

        Raises `ValueError` where the model has no recipe, and for a statement that was proved wrong.
        """
        return write(path, self.document())

    @classmethod
    def load(cls, path: str | Path, *, model: Any = None) -> "ContractionCertificate":
        """Read a saved certificate with all its boxes; the time of the proofs is not in the file (NaN).

        It is checked that the boxes cover the region and that the statement follows from the claims. Whether the claims
        hold is checked only by `covariant certify --check`; until then the certificate is not `verified`.

        `model`: where the recipe names a model that is not of this library, the caller gives it: the model, a function
        that makes it from the recipe's parameters, or the `module:attribute` of either. Raises `ValueError` naming file
        and key.
        """
        document, observer, about = follows(parse(path), model)
        domain = Box(about.names, about.units, document.low, document.high)
        claims = tuple(
            Claim(said.kind, Proof.stated(domain, from_letters(said.levels)), said.row, said.square, said.limit)
            for said in document.claims
        )
        given = _plain(document.given)
        summary = summary_of(domain, document.velocity, document.rate, document.radius, given, claims)
        return cls(
            summary._replace(
                statement=f"{summary.statement} (read from a file, not verified again)", evidence="claimed"
            ),
            document.rate,
            document.radius,
            observer,
            document.q,
            about,
            domain,
            document.velocity,
            given,
            claims,
            document.recipe,
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


def summary_of(
    domain: Box, velocity, rate: float, radius: float, given: dict[str, Any], claims: Sequence[Claim]
) -> Certificate:
    verdicts = {claim.proof.verdict for claim in claims}
    verdict = "fails" if "fails" in verdicts else "undecided" if "undecided" in verdicts or not radius else "holds"
    wrong = next((c.proof.counterexample for c in claims if c.proof.counterexample is not None), None)
    if verdict == "holds":
        steady = steady_distance(rate, disturbance_length(given, claims))
        statement = _said(velocity, rate, radius, steady) + _under(given)
    else:
        statement = f"squared lengths shrink at {rate:.4g} 1/s or faster on the region"
        reasons = [claim.proof.reason for claim in claims if claim.proof.reason]
        if verdicts == {"holds"}:
            length = steady_distance(rate, disturbance_length(given, claims))
            reasons = [f"noise and disturbance alone lead {length:.4g} away, out of the tube; make them smaller"]
        statement += f"; {reasons[0]}" if reasons and verdict == "undecided" else ""
    return Certificate(
        statement,
        verdict,
        rate,
        str(domain),
        "proved",
        () if wrong is None else tuple(((wrong[0] + wrong[1]) / 2).tolist()),
    )


def _under(given: dict[str, Any]) -> str:
    """The errors that a statement allows, in words; empty where it allows none."""
    words = {"noise": "measurement errors", "disturbance": "unknown forces"}
    bounds = {word: ", ".join(f"{bound:.4g}" for bound in given[key]) for key, word in words.items() if any(given[key])}
    return f", under {' and '.join(f'{word} up to {b}' for word, b in bounds.items())}" if bounds else ""


def _said(velocity, rate: float, radius: float, steady: float) -> str:
    bounds = ", ".join(f"{v:.4g}" for v in velocity)
    fall = f"at {rate / 2:.4g} 1/s or faster" + (f" to {steady:.4g} or less" if steady else "")
    about = f"estimates within {radius:.4g} of a solution with velocities up to {bounds}"
    return f"{about} stay so, and their distance falls {fall}"


def _plain(given: Given) -> dict[str, Any]:
    """The given bounds as data for the file."""

    def pair(bounds: np.ndarray) -> dict[str, list[float]]:
        return {"low": bounds[0].tolist(), "high": bounds[1].tolist()}

    rest = {key: getattr(given, key).tolist() for key in ("times", "noise", "disturbance", "slopes")}
    return {"positions": pair(given.positions), "inputs": pair(given.inputs), **rest}
