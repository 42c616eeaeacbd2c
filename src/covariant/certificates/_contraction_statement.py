"""The statement of a proof of contraction: its claim in words with all numbers, and its hypotheses."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates._assumed import ASSUMED
from covariant.certificates._claims import Claim, disturbance_length, plain_bounds, stated_claims
from covariant.certificates._document import Document
from covariant.certificates._error_system import ErrorSystem
from covariant.certificates._intrinsic import Intrinsics
from covariant.certificates._noise import steady_distance
from covariant.certificates._saved import observer_document
from covariant.certificates._statement import Evidence, Hypothesis, Statement
from covariant.certificates._tangent_metric import TwoByTwo
from covariant.models import recipe_text
from covariant.proofs import Box


class Contraction(NamedTuple):
    """All that a statement about an intrinsic observer is derived from.

    Attributes:
        rate, radius, observer, q, domain, velocity, given, claims, recipe: as in `ContractionCertificate`.
    """

    rate: float
    radius: float
    observer: Intrinsics
    q: TwoByTwo
    domain: Box
    velocity: Float[np.ndarray, "n"]
    given: dict[str, Any]
    claims: Sequence[Claim]
    recipe: dict[str, Any] | None

    @classmethod
    def stated(cls, document: Document, observer: Intrinsics, about: ErrorSystem) -> "Contraction":
        """Collect what a file states.

        Args:
            document: the parsed file.
            observer: the observer of the file.
            about: observer and metric as functions of a box.
        """
        domain = Box(about.names, about.units, document.low, document.high)
        return cls(
            document.rate,
            document.radius,
            observer,
            document.q,
            domain,
            document.velocity,
            plain_bounds(document.given),
            stated_claims(document, domain),
            document.recipe,
        )

    @property
    def steady(self) -> float:
        """The distance to which noise and disturbance alone may lead."""
        return steady_distance(self.rate, disturbance_length(self.given, self.claims))


def contraction_statement(of: Contraction, evidence: Evidence, checker: Hypothesis | None = None) -> Statement:
    """Write the statement of a proof, with its verdict.

    Args:
        of: what was proved.
        evidence: that of the claims, "proved" or "claimed" by a file.
        checker: the result of the checker, as from `judged`; None where it did not run.

    Returns:
        The statement, with the rate λ [1/s] of squared lengths as margin.
    """
    hypotheses = (*_hypotheses(of, evidence), *(() if checker is None else (checker,)), *_assumed())
    counterexample = next((c.proof.counterexample for c in of.claims if c.proof.counterexample is not None), None)
    point = () if counterexample is None else tuple(counterexample.mean(axis=0).tolist())
    draft = Statement("", (), hypotheses, of.rate, str(of.domain), point)
    # There is no tube without a proof, so its radius is not printed.
    data = tuple(_description(of if draft.verdict == "holds" else of._replace(radius=0.0)))
    claim = (
        _converges(of)
        if draft.verdict == "holds"
        else f"squared lengths shrink at {of.rate:.4g} 1/s or faster on the region"
    )
    if draft.verdict == "undecided":
        reasons = [h.place for h in hypotheses if h.verdict == "undecided" and h.place]
        claim += f"; {reasons[0]}" if reasons else ""
    return draft._replace(claim=claim, about=data)


def _converges(facts: Contraction) -> str:
    speeds, conditions = ", ".join(f"{v:.4g}" for v in facts.velocity), []
    for key, label in (("noise", "measurement errors"), ("disturbance", "unknown forces")):
        if any(facts.given[key]):
            conditions.append(f"{label} up to {', '.join(f'{bound:.4g}' for bound in facts.given[key])}")
    end = f" to {facts.steady:.4g} or less" if facts.steady else ""
    return (
        f"estimates within {_down(facts.radius)} of a solution with velocities up to {speeds} stay so, and their "
        f"distance falls at {_down(facts.rate / 2)} 1/s or faster{end}"
        + (f", under {' and '.join(conditions)}" if conditions else "")
    )


def _hypotheses(facts: Contraction, evidence: Evidence) -> Iterator[Hypothesis]:
    n, names = len(facts.velocity), facts.domain.names
    for claim in facts.claims:
        proof, reach = claim.proof, facts.radius * math.sqrt(claim.square)
        if claim.kind == "contraction":
            text, margin = (
                f"squared lengths shrink at {_exact(facts.rate)} 1/s or faster everywhere in the domain",
                None,
            )
        elif claim.kind == "reach":
            # Errors of the position come first, then the velocities.
            name = names[len(names) - 2 * n + claim.row] if claim.row < n else names[len(names) - 4 * n + claim.row]
            text = f"a curve of the length of the radius reaches less than {claim.limit:.4g} far in {name}"
            margin = claim.limit - reach if facts.radius else None
        else:
            text, margin = "noise and unknown forces add no more to the flow than the radius allows", None
        yield Hypothesis(text, evidence, proof.verdict, margin, proof.reason)
    if all(claim.proof.verdict == "holds" for claim in facts.claims):
        yield _radius(facts, evidence)
    yield Hypothesis("over these positions, inputs and times the force stays within the bounds of the domain", evidence)
    yield Hypothesis(
        "the errors are below half a turn, so that the shortest path to the measurement is unique", evidence
    )
    yield Hypothesis(
        f"the observer is {type(facts.observer).__name__} itself, whose flow is the one described", evidence
    )


def _assumed() -> Iterator[Hypothesis]:
    for line in ASSUMED:
        yield Hypothesis(line, "assumed")


def _radius(facts: Contraction, evidence: Evidence) -> Hypothesis:
    """That the tube is there, and that noise does not lead out of it."""
    if facts.radius > facts.steady:
        return Hypothesis(
            "the tube has a radius, and noise and unknown forces alone do not lead out of it",
            evidence,
            margin=facts.radius - facts.steady,
        )
    reason = f"noise and disturbance alone lead {facts.steady:.4g} away, out of the tube; make them smaller"
    return Hypothesis("noise and unknown forces alone do not lead out of the tube", evidence, "undecided", None, reason)


def _description(facts: Contraction) -> Iterator[str]:
    """Lines from which the claim can be repeated."""
    model, n = facts.observer.model, len(facts.velocity)
    fields, unit_of = observer_document(facts.observer), dict(zip(facts.domain.names, facts.domain.units, strict=True))
    kind, frame = fields.pop("kind"), fields.pop("frame")
    alpha, beta = (_exact(fields.pop(name)) for name in ("alpha", "beta"))
    options = "".join(f", {name} = {value}" for name, value in fields.items())
    yield f"model: {'one that was given as an object' if facts.recipe is None else recipe_text(facts.recipe)}"
    yield f"observer: {kind} in the frame of {frame}, alpha = {alpha} 1/s, beta = {beta} 1/s²{options}; continuous time"
    yield f"metric: Q = {_rows(facts.q)}"
    if facts.radius:
        yield f"rate λ = {_down(facts.rate)} 1/s of squared lengths, radius ε = {_down(facts.radius)} in this metric"
    positions = facts.given["positions"]
    if model.manifold.commuting:
        ends = zip(positions["low"], positions["high"], strict=True)
        named = zip(model.coordinates, ends, strict=True)
        yield "true positions: " + ", ".join(_between(name, *pair, unit_of.get(name, "")) for name, pair in named)
    else:
        yield f"true positions: entries of the matrices from {_list(positions['low'])} to {_list(positions['high'])}"
    speeds, errors = facts.domain.names[-3 * n : -2 * n], facts.domain.names[-2 * n : -n]
    yield "true velocities up to: " + _up_to(speeds, facts.velocity, unit_of)
    yield "errors of the estimated position up to: " + _up_to(errors, facts.domain.high[-2 * n : -n], unit_of)
    inputs = facts.given["inputs"]
    pairs = enumerate(zip(inputs["low"], inputs["high"], strict=True), start=1)
    yield f"inputs: {', '.join(_between(f'u{i}', *pair, '') for i, pair in pairs) or 'none'}"
    first, last = facts.given["times"]
    yield f"times: {_exact(first)} to {_exact(last)} s" + (
        ", or any, where the force does not read them" if first == last else ""
    )
    yield f"errors of the measured position up to: {_list(facts.given['noise'])}"
    yield f"unknown forces up to: {_list(facts.given['disturbance'])}"
    yield f"domain of the proofs: {facts.domain}"


def _between(name: str, low: float, high: float, unit: str) -> str:
    return f"{name} {_exact(low)} to {_exact(high)} {unit}".rstrip()


def _up_to(names: Sequence[str], bounds: Sequence[float] | np.ndarray, units: dict[str, str]) -> str:
    return ", ".join(f"{name} {_exact(b)} {units[name]}".rstrip() for name, b in zip(names, bounds, strict=True))


def _rows(matrix: np.ndarray) -> str:
    return _list([_list(row) for row in np.asarray(matrix).tolist()])


def _list(values: Sequence[Any]) -> str:
    return "[" + ", ".join(v if isinstance(v, str) else _exact(v) for v in values) + "]"


def _exact(value: float) -> str:
    """The shortest text that is this number."""
    return repr(float(value)).removesuffix(".0")


def _down(value: float) -> str:
    """A number of four digits that is no larger: what is claimed is never more than what is proved."""
    text = f"{value:.4g}"
    if float(text) <= value:
        return text
    # `.4g` rounds to nearest; one unit of the last of four digits less is below the value.
    last = math.floor(math.log10(abs(value))) - 3
    return f"{float(text) - 10.0**last:.4g}"
