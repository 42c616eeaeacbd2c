"""Proved contraction of an intrinsic observer on a region: the statement and its claims, to be saved and read."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates._check import follows
from covariant.certificates._claims import Claim, disturbance_length
from covariant.certificates._contraction_statement import Contraction, contraction_statement
from covariant.certificates._document import FORMAT, parse, write
from covariant.certificates._intrinsic import Intrinsics
from covariant.certificates._noise import steady_distance
from covariant.certificates._saved import observer_document, value_graph
from covariant.certificates._statement import Statement
from covariant.certificates._subject import Subject
from covariant.certificates._tangent_metric import TwoByTwo
from covariant.proofs import Box, digest


class ContractionCertificate(NamedTuple):
    """Result of a proof about an observer on a region.

    - `statement`: the claim, its hypotheses and so its verdict, and its margin, the rate λ [1/s] of squared lengths.
    - `rate`: λ [1/s]; `radius`: ε, in the metric of Q on states; 0 unless the verdict is "holds".
    - `observer`, `q` (2, 2): the observer, and the matrix Q of the metric; `subject`: both as functions of a box.
    - `domain`: the box of estimate, error and force; `velocity` (n,): the bound of the true velocity.
    - `given`: positions, inputs and times from which the bounds of the force follow; `noise`, `disturbance`, `slopes`.
    - `claims`: the inequalities, with their proofs.
    - `recipe`: where the model comes from, as from `models.recipe`; None for a model that only this process knows.
    - `verified`: whether it was proved in this process. A certificate that was read from a file is only as trustworthy
      as the file, until `covariant certify --check` has verified it.
    - `checker_seconds`: time [s] that the checker looked at it in this process.
    """

    statement: Statement
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
    checker_seconds: float = 0.0

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
        if self.statement.verdict != "holds":
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
        if self.statement.verdict == "undecided" and not len(self.open):
            raise ValueError(f"nothing is proved that could be saved: {self.statement.claim}")
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
        facts = Contraction.stated(document, observer, about)
        statement = contraction_statement(facts, "claimed")
        return cls(
            statement._replace(claim=f"{statement.claim} (read from a file, not verified again)"),
            facts.rate,
            facts.radius,
            facts.observer,
            facts.q,
            about,
            facts.domain,
            facts.velocity,
            facts.given,
            tuple(facts.claims),
            facts.recipe,
        )
