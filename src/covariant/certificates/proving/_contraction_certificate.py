"""Defines the certificate of a contracting intrinsic observer: a statement and its claims, which are saved and read."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from covariant.certificates.base import (
    FORMAT,
    AbstractClaim,
    Document,
    ErrorSystem,
    Given,
    Intrinsics,
    PredictionClaim,
    Recursion,
    Remainder,
    Resolved,
    Sampling,
    Start,
    StartClaim,
    Statement,
    TwoByTwo,
    check_recipe,
    contraction_statement,
    loss_of,
    observer_document,
    parse,
    reach_squares,
    select,
    start_of,
    steady_of,
    true_region,
    value_graph,
    write,
)
from covariant.certificates.checking import check, follows
from covariant.certificates.sampled import ROUND, Bounded, SampledBound
from covariant.observers import AbstractObserver
from scalargraph.errors import InputError
from scalargraph.proofs import Box, digest

FARTHEST = 1e30
"""The limit of a position that has none."""
SAMPLED_ROLES = ("joint force", "friction slope")
"""Kinds of variables that only boxes with samples have, besides the age."""


class ContractionCertificate(NamedTuple):
    """Result of a proof that an intrinsic observer contracts on a region.

    Attributes:
        statement: the claim and its hypotheses, which determine the verdict; its margin is the rate λ.
        rate: rate λ [1/s] at which squared lengths decrease.
        radius: radius ε of the tube, in the metric of Q on states; 0 unless the verdict is "holds".
        observer: the observer.
        q: the matrix Q (2, 2) of the metric.
        error_system: observer and metric as functions of a box.
        domain: the box of estimate, error and force.
        velocity: bound (n,) of each true velocity [unit/s].
        given: the bounds of positions, inputs and times, from which the bounds of the force follow, and the bounds of
            noise and disturbance.
        claims: the inequalities, with their proofs.
        recipe: the origin of the model, as from `models.recipe`; None for a model that only this process knows.
        verified: whether it was proved in this process. A certificate that was read from a file is only as trustworthy
            as the file, until `covariant certify --check` has verified it.
        checker_seconds: time [s] that the checker spent on it in this process.
        sampling: when measurements come, and the metric between them; None for an observer in continuous time.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> from covariant.certificates import ContractionCertificate, Hypothesis, Statement
        >>> from covariant.certificates.base import Given
        >>> from scalargraph.proofs import box
        >>> statement = Statement("the observer contracts", (), (Hypothesis("it contracts", "proved"),), 2.0)
        >>> domain = box(v=(-1.0, 1.0), e=(-0.1, 0.1), f=(0.0, 0.0))
        >>> given = Given(*np.zeros((2, 2, 1)), np.zeros(2), *np.zeros((2, 1)), np.zeros((1, 1)))
        >>> observer = observers.Intrinsic(models.oscillator(), 4.0, 8.0)
        >>> entries = statement, 2.0, 0.1, observer, np.eye(2), None, domain, np.ones(1), given, (), None
        >>> certificate = ContractionCertificate(*entries)  # usually from `certify`
        >>> certificate.decay, certificate.steady, certificate.kinds
        (1.0, 0.0, ('velocity', 'error', 'force'))
    """

    statement: Statement
    rate: float
    radius: float
    observer: Intrinsics
    q: TwoByTwo
    error_system: ErrorSystem
    domain: Box
    velocity: Float[np.ndarray, "n"]
    given: Given
    claims: tuple[AbstractClaim, ...]
    recipe: dict[str, Any] | None
    verified: bool = False
    checker_seconds: float = 0.0
    sampling: Sampling | None = None

    @classmethod
    def of(
        cls, facts: Resolved, statement: Statement, verified: bool = False, checker_seconds: float = 0.0
    ) -> "ContractionCertificate":
        """Collect a certificate.

        Args:
            facts: the proved or read document, with the observer.
            statement: the statement about it.
            verified, checker_seconds: as in the attributes.
        """
        document = facts.document
        return cls(
            statement,
            document.rate,
            document.radius,
            facts.observer,
            document.q,
            facts.about,
            facts.domain,
            document.velocity,
            document.given,
            document.claims,
            document.recipe,
            verified,
            checker_seconds,
            document.sampling,
        )

    @property
    def decay(self) -> float:
        """Decay rate μ [1/s]: distances decrease as `e^(−μt)`.

        Returns:
            λ/2; with sampled measurements less the loss by the factor of the correction. For `Geodesic` less what it
            differs from `Intrinsic` at the radius; the rate of closer estimates approaches λ/2.
        """
        gains = float(self.observer.alpha), float(self.observer.beta)
        remainder = Remainder.of(gains, self.q, self.claims, self.radius)
        return self.rate / 2 - loss_of(self.sampling, self.q, self.rate, self.claims).rate - remainder.rate

    @property
    def steady(self) -> float:
        """An upper bound of the final distance.

        Returns:
            `2D/λ` for the noise and disturbance of the certificate. With sampled measurements it is the fixed point of
            the recursion that `bound` runs, with noise, disturbance and, if a claim bounds them, the errors of the
            prediction's Runge–Kutta steps. 0 without all of these.
        """
        return steady_of(self.sampling, self.q, self.rate, self.given, self.claims)

    @property
    def boxes(self) -> int:
        """Number of boxes evaluated, over all claims."""
        return sum(claim.proof.boxes for claim in self.claims)

    @property
    def seconds(self) -> float:
        """Time of the proofs [s]; NaN for a certificate that was read from a file."""
        return sum(claim.proof.seconds for claim in self.claims)

    @property
    def counterexample(self) -> Float[np.ndarray, "2 d"] | None:
        """A box (2, d), low then high ends, on which the statement was proved wrong, or None."""
        return next((c.proof.counterexample for c in self.claims if c.proof.counterexample is not None), None)

    @property
    def half_widths(self) -> Float[np.ndarray, "two_n"]:
        """Half widths of the proved tube, (2n,).

        Returns:
            Half widths in each position error [unit], then in each velocity error [unit/s].

        Raises:
            ValueError: no tube has been proved.
        """
        if self.statement.verdict != "holds":
            raise InputError("no tube, since nothing is proved on the region")
        return self.radius * np.sqrt(reach_squares(self.claims))

    @property
    def start(self) -> Start | None:
        """The initial errors that the radius covers, in the units of the model.

        Returns:
            Errors in positions and velocities; None on a group, or if nothing is proved.
        """
        if self.statement.verdict != "holds":
            return None
        return start_of(self.radius, self.domain, self.claims)

    def bounded(
        self,
        observer: AbstractObserver | None = None,
        *,
        position: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        radius: float | None = None,
    ) -> Bounded:
        """Build the observer whose step also returns a proved bound of its error, for sampled measurements.

        `init` starts from rest at the first measurement. The bound needs the error of this start: `position` and
        `velocity`, or `radius`. Without `velocity` and `radius` all bounds are infinite.

        Args:
            observer: the observer that runs: the certified one (default), or the certified one behind a gate.
            position: bounds (n,) of the position errors at the start [unit], or one for all; by default the `noise` of
                the certificate.
            velocity: bounds (n,) of the true velocities at the start [unit/s], or one for all.
            radius: instead of these two, a bound of the distance at the start, in the metric of the certificate.

        Returns:
            The observer with its bound.

        Raises:
            ValueError: nothing is proved, the certificate is in continuous time, the observer is another one, or a
                bound is negative or not a number.
        """
        if self.sampling is None:
            raise InputError(
                "bounds beside every sample need certify(..., interval=...); this one is in continuous time"
            )
        if self.statement.verdict != "holds":
            raise InputError("no bound beside every sample, since nothing is proved on the region")
        if not self.verified:
            raise InputError(
                "bounded: this certificate was read from a file and is not verified; give load(..., verify=True)"
            )
        squares, factors = reach_squares(self.claims), select(self.claims, StartClaim)
        model, n = self.observer.model, len(self.velocity)
        bound = SampledBound(
            self.observer,
            Recursion.of(self.sampling, self.q, self.rate, self.given, self.claims),
            self.radius,
            np.sqrt(squares) * (1 + ROUND),
            factors[0].square / squares if factors else np.full(len(squares), np.inf),
            # A finite number stands for infinity, whose middle and size are computed in each step.
            np.clip(true_region(model, self.given.positions), -FARTHEST, FARTHEST),
            self.velocity,
            self.given.inputs,
            self.given.noise,
            self.sampling.substeps,
            self.sampling.longest_step if select(self.claims, PredictionClaim) else 0.0,
            self.sampling.missing_rows,
            tuple(i in model.circles for i in range(n)) if model.manifold.commuting else None,
        )
        if radius is None:
            speed = np.inf if velocity is None else velocity
            first = bound.within(self.given.noise if position is None else position, speed)
        elif position is None and velocity is None and np.ndim(radius) == 0 and np.isreal(radius) and radius >= 0:
            first = bound.known(float(radius))
        else:
            raise InputError(f"bounded: give a radius ≥ 0, or bounds of position and velocity; got the radius {radius}")
        return Bounded(self.observer if observer is None else observer, bound, first)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kind of each variable of the domain.

        Returns:
            "estimate", "velocity" (estimated), "error" or "force" for each; with samples also "joint force", "friction
            slope" and "age"; if friction is a variable too, also "friction" and "friction slope"; "signal" for time and
            inputs that the friction depends on.
        """
        n, driven = len(self.velocity), len(self.error_system.driven) if self.error_system is not None else 0
        roles = ("estimate", "velocity", "error", "force")
        variables = len(self.domain.low) - driven
        parts = {3 * n: roles[1:], 4 * n: roles}.get(variables, (*roles, "friction", "friction slope"))
        if self.sampling is not None:
            estimate = ("estimate",) * self.error_system.first_velocity(n)
            return (*estimate, *(role for role in (*roles[1:], *SAMPLED_ROLES) for _ in range(n)), "age")
        return (*(role for role in parts for _ in range(n)), *("signal",) * driven)

    @property
    def open(self) -> Float[np.ndarray, "k 2 d"]:
        """Boxes (k, 2, d), low then high ends, that remained undecided."""
        return np.concatenate([claim.proof.open for claim in self.claims])

    def document(self) -> dict[str, Any]:
        """Convert the certificate to data for the file.

        Returns:
            A dictionary of plain numbers and texts, with a digest of its content.

        Raises:
            ValueError: the model has no recipe, nothing is proved, or the statement was proved wrong.
        """
        if self.recipe is None:
            raise InputError("a certificate is saved with its model; give certify(..., recipe=models.recipe(spec))")
        if self.statement.verdict == "undecided" and not len(self.open):
            raise InputError(f"nothing is proved that could be saved: {self.statement.claim}")
        if self.counterexample is not None:
            raise InputError("the statement is wrong, and a counter-example is printed, not saved; certify another one")
        content = {
            "format": FORMAT,
            "recipe": {"parameters": {}} | self.recipe,
            "observer": observer_document(self.observer),
            "q": self.q.tolist(),
            "rate": self.rate,
            "radius": self.radius,
            "velocity": self.velocity.tolist(),
            "given": self.given.document(),
            "box": {"low": self.domain.low.tolist(), "high": self.domain.high.tolist()},
            "claims": [claim.document() for claim in self.claims],
            "graph": value_graph(self.error_system),
        }
        content |= {} if self.sampling is None else {"sampling": self.sampling.document()}
        content |= {"driven": list(driven)} if (driven := self.error_system.driven) else {}
        return content | {"digest": digest(content)}

    def save(self, path: str | Path) -> Path:
        """Write the certificate with all its boxes as JSON, as data that executes nothing when it is read.

        Args:
            path: the file.

        Returns:
            The path.

        Raises:
            ValueError: the model has no recipe, the recipe is of another model, nothing is proved, or the statement was
                proved wrong.
        """

        def check(written: Document) -> None:
            # The code named by a recipe is not run here: the reader of the file provides the model, which is compared.
            if written.recipe is not None and "system" in written.recipe:
                check_recipe(self.observer.model, written.recipe)

        return write(path, self.document(), check)

    @classmethod
    def load(cls, path: str | Path, *, model: object = None, verify: bool = False) -> "ContractionCertificate":
        """Read a saved certificate with all its boxes.

        It is checked that the boxes cover the region, and that the statement follows from the claims. The claims
        themselves are checked with `verify`, or by `covariant certify --check`; until then the certificate is not
        `verified`, and does not provide bounds for an observer.
        The file does not contain the time of the proofs (NaN).

        Args:
            path: the file.
            model: for a recipe of a model that is not part of this library: the model, a function that creates it
                from the recipe's parameters, or the `module:attribute` of either.
            verify: let the checker show the claims too, which may take as long as their proof.

        Returns:
            The certificate; its claims have the evidence "claimed", or with `verify` "proved".

        Raises:
            ValueError: The file is invalid; the message names file and key.
        """
        document = parse(path)
        facts = follows(document, model).stated()
        if verify:
            checked = check(document, model=model)
            return cls.of(facts, checked.statement, verified=True, checker_seconds=checked.seconds)
        statement = contraction_statement(facts, "claimed")
        return cls.of(facts, statement._replace(claim=f"{statement.claim} (read from a file, not verified again)"))
