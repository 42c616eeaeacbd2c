"""What was proved about an intrinsic observer on a region: the statement, its claims, and how it is saved and read."""

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
    - "contraction": squared lengths shrink at the rate of the certificate;
    - "reach": a curve of length ℓ changes the entry `row` of (error, velocity) by less than `ℓ √square`, which bounds
      the half width of the tube there, and that may be up to `limit`;
    - "disturbance": what errors of measurement and force, in the unit ball by their sizes, add to the flow is no longer
      than `√square`.
    """

    kind: Kind
    proof: Proof
    row: int = 0
    square: float = 0.0
    limit: float = 0.0

    def document(self) -> dict[str, Any]:
        """The claim as it is saved."""
        numbers = {key: getattr(self, key) for key in NUMBERS[self.kind]}
        return {"kind": self.kind, **numbers, "levels": to_letters(self.proof.levels)}


class ContractionCertificate(NamedTuple):
    """What was proved about an observer on a region.

    - `summary`: the statement, its verdict, and its margin, the rate λ [1/s] of squared lengths.
    - `radius`: ε, in the metric of Q on states; 0 unless the verdict is "holds".
    - `domain`: the box of estimate, error and force; `velocity` (n,): the bound of the true velocity.
    - `given`: positions, inputs and times that the bounds of the force come from; `noise`, `disturbance`, `slopes`.
    - `recipe`: where the model comes from, as `models.recipe`; None for a model known to this process only.
    - `verified`: whether it was proved in this process. One that was read from a file is as good as the file, until
      `covariant certify --check` has verified it.
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
        """μ [1/s]: the distance falls as `e^(−μt)`, half the rate."""
        return self.rate / 2

    @property
    def steady(self) -> float:
        """What the distance comes down to under the noise and disturbance of the certificate, `2D/λ`; 0 without."""
        return steady_distance(self.rate, disturbance_length(self.given, self.claims))

    @property
    def boxes(self) -> int:
        """Boxes evaluated."""
        return sum(claim.proof.boxes for claim in self.claims)

    @property
    def seconds(self) -> float:
        """Time that the proofs took [s]."""
        return sum(claim.proof.seconds for claim in self.claims)

    @property
    def counterexample(self) -> Float[np.ndarray, "2 d"] | None:
        """Where the statement was proved wrong."""
        return next((c.proof.counterexample for c in self.claims if c.proof.counterexample is not None), None)

    @property
    def half_widths(self) -> Float[np.ndarray, "two_n"]:
        """How far the proved tube extends in each position error [unit], then in each velocity error [unit/s].

        Raises `ValueError` where no tube is proved.
        """
        if self.summary.verdict != "holds":
            raise ValueError("no tube, since nothing is proved on the region")
        return self.radius * np.sqrt([claim.square for claim in self.claims if claim.kind == "reach"])

    @property
    def kinds(self) -> tuple[str, ...]:
        """What each variable of the domain is: "estimate", "velocity" (estimated), "error" or "force"."""
        n = len(self.velocity)
        words = ("estimate", "velocity", "error", "force")
        parts = words if len(self.domain.low) == 4 * n else words[1:]
        return tuple(word for word in parts for _ in range(n))

    @property
    def open(self) -> Float[np.ndarray, "k 2 d"]:
        """Boxes on which the time did not suffice to decide."""
        return np.concatenate([claim.proof.open for claim in self.claims])

    def document(self) -> dict[str, Any]:
        """The certificate as it is saved.

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
        """Write the certificate with all its boxes (JSON), as data that runs nothing where it is read.

        Raises `ValueError` where the model has no recipe, and for a statement that was proved wrong.
        """
        return write(path, self.document())

    @classmethod
    def load(cls, path: str | Path, *, model: Any = None) -> "ContractionCertificate":
        """A saved certificate with all its boxes; how long the proofs took is not in the file (NaN).

        Checked is that the boxes cover the region and that the statement follows from the claims; that these hold is
        for `covariant certify --check` to say, and until then the certificate is not `verified`. `model`: where the
        recipe names somebody's own model, whoever reads the file gives it: the model, or a function that makes it of
        the recipe's parameters, or the `module:attribute` of either. Raises `ValueError` naming file and key.
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
    """Largest errors of the measured position, and of the force: unknown, or taken at the wrong place.

    All at once are in the ball of radius √m of these sizes, m of them not being zero.
    """
    noise, unknown, slopes = (np.asarray(given[name], float) for name in ("noise", "disturbance", "slopes"))
    through = (np.reshape(slopes, (len(noise), -1)) * noise).sum(axis=1) * (1 + 1e-12)
    return np.concatenate([noise, unknown + through])


def disturbance_length(given: dict[str, Any], claims: Sequence[Claim]) -> float:
    """D: the largest length of what noise and disturbance add to the flow; 0 where none are given, ∞ if not proved."""
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
    """The errors that a statement allows for; nothing where it allows for none."""
    words = {"noise": "measurement errors", "disturbance": "unknown forces"}
    bounds = {word: ", ".join(f"{bound:.4g}" for bound in given[key]) for key, word in words.items() if any(given[key])}
    return f", under {' and '.join(f'{word} up to {b}' for word, b in bounds.items())}" if bounds else ""


def _said(velocity, rate: float, radius: float, steady: float) -> str:
    bounds = ", ".join(f"{v:.4g}" for v in velocity)
    fall = f"at {rate / 2:.4g} 1/s or faster" + (f" to {steady:.4g} or less" if steady else "")
    about = f"estimates within {radius:.4g} of a solution with velocities up to {bounds}"
    return f"{about} stay so, and their distance falls {fall}"


def _plain(given: Given) -> dict[str, Any]:
    """What is given, as it is saved."""

    def pair(bounds: np.ndarray) -> dict[str, list[float]]:
        return {"low": bounds[0].tolist(), "high": bounds[1].tolist()}

    rest = {key: getattr(given, key).tolist() for key in ("times", "noise", "disturbance", "slopes")}
    return {"positions": pair(given.positions), "inputs": pair(given.inputs), **rest}
