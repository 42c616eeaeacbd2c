"""The statement of a proof of contraction: what it is about, in words with all its numbers, and its hypotheses."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates._assumed import ASSUMED
from covariant.certificates._claims import Claim, disturbance_length, plain_bounds, stated_claims
from covariant.certificates._document import Document
from covariant.certificates._intrinsic import Intrinsics
from covariant.certificates._noise import steady_distance
from covariant.certificates._saved import observer_document
from covariant.certificates._statement import Evidence, Hypothesis, Statement
from covariant.certificates._subject import Subject
from covariant.certificates._tangent_metric import TwoByTwo
from covariant.models import recipe_text
from covariant.proofs import Box


class Contraction(NamedTuple):
    """All that a statement about an intrinsic observer is made of; the fields are those of `ContractionCertificate`."""

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
    def stated(cls, document: Document, observer: Intrinsics, about: Subject) -> "Contraction":
        """What a file states, with the observer that it is about."""
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
    """The statement with its verdict.

    - `evidence`: that of the claims, "proved" or "claimed" by a file.
    - `checker`: what the checker says of the proofs, as from `judged`; None where it was not asked.
    """
    hypotheses = (*_hypotheses(of, evidence), *(() if checker is None else (checker,)), *_assumed())
    wrong = next((c.proof.counterexample for c in of.claims if c.proof.counterexample is not None), None)
    point = () if wrong is None else tuple(wrong.mean(axis=0).tolist())
    found = Statement("", (), hypotheses, of.rate, str(of.domain), point)
    # Of what is not shown there is no tube.
    about = tuple(_about(of if found.verdict == "holds" else of._replace(radius=0.0)))
    claim = (
        _converges(of)
        if found.verdict == "holds"
        else f"squared lengths shrink at {of.rate:.4g} 1/s or faster on the region"
    )
    if found.verdict == "undecided":
        reasons = [h.place for h in hypotheses if h.verdict == "undecided" and h.place]
        claim += f"; {reasons[0]}" if reasons else ""
    return found._replace(claim=claim, about=about)


def _converges(of: Contraction) -> str:
    speeds, under = ", ".join(f"{v:.4g}" for v in of.velocity), []
    for key, words in (("noise", "measurement errors"), ("disturbance", "unknown forces")):
        if any(of.given[key]):
            under.append(f"{words} up to {', '.join(f'{bound:.4g}' for bound in of.given[key])}")
    end = f" to {of.steady:.4g} or less" if of.steady else ""
    return (
        f"estimates within {_down(of.radius)} of a solution with velocities up to {speeds} stay so, and their distance "
        f"falls at {_down(of.rate / 2)} 1/s or faster{end}" + (f", under {' and '.join(under)}" if under else "")
    )


def _hypotheses(of: Contraction, evidence: Evidence) -> Iterator[Hypothesis]:
    n, names = len(of.velocity), of.domain.names
    for claim in of.claims:
        found, reach = claim.proof, of.radius * math.sqrt(claim.square)
        if claim.kind == "contraction":
            text, margin = f"squared lengths shrink at {_exact(of.rate)} 1/s or faster everywhere in the domain", None
        elif claim.kind == "reach":
            # Errors of the position come first, then the velocities.
            name = names[len(names) - 2 * n + claim.row] if claim.row < n else names[len(names) - 4 * n + claim.row]
            text = f"a curve of the length of the radius reaches less than {claim.limit:.4g} far in {name}"
            margin = claim.limit - reach if of.radius else None
        else:
            text, margin = "noise and unknown forces add no more to the flow than the radius allows", None
        yield Hypothesis(text, evidence, found.verdict, margin, found.reason)
    if all(claim.proof.verdict == "holds" for claim in of.claims):
        yield _radius(of, evidence)
    yield Hypothesis("over these positions, inputs and times the force stays within the bounds of the domain", evidence)
    yield Hypothesis(
        "the errors are below half a turn, so that the shortest path to the measurement is unique", evidence
    )
    yield Hypothesis(f"the observer is {type(of.observer).__name__} itself, whose flow is the one described", evidence)


def _assumed() -> Iterator[Hypothesis]:
    for line in ASSUMED:
        yield Hypothesis(line, "assumed")


def _radius(of: Contraction, evidence: Evidence) -> Hypothesis:
    """That the tube is there, and that noise does not lead out of it."""
    if of.radius > of.steady:
        return Hypothesis(
            "the tube has a radius, and noise and unknown forces alone do not lead out of it",
            evidence,
            margin=of.radius - of.steady,
        )
    why = f"noise and disturbance alone lead {of.steady:.4g} away, out of the tube; make them smaller"
    return Hypothesis("noise and unknown forces alone do not lead out of the tube", evidence, "undecided", None, why)


def _about(of: Contraction) -> Iterator[str]:
    """Lines from which the claim can be repeated."""
    model, n = of.observer.model, len(of.velocity)
    fields, unit_of = observer_document(of.observer), dict(zip(of.domain.names, of.domain.units, strict=True))
    kind, frame = fields.pop("kind"), fields.pop("frame")
    alpha, beta = (_exact(fields.pop(name)) for name in ("alpha", "beta"))
    options = "".join(f", {name} = {value}" for name, value in fields.items())
    yield f"model: {'one that was given as an object' if of.recipe is None else recipe_text(of.recipe)}"
    yield f"observer: {kind} in the frame of {frame}, alpha = {alpha} 1/s, beta = {beta} 1/s²{options}; continuous time"
    yield f"metric: Q = {_rows(of.q)}"
    if of.radius:
        yield f"rate λ = {_down(of.rate)} 1/s of squared lengths, radius ε = {_down(of.radius)} in this metric"
    positions = of.given["positions"]
    if model.manifold.commuting:
        ends = zip(positions["low"], positions["high"], strict=True)
        named = zip(model.coordinates, ends, strict=True)
        yield "true positions: " + ", ".join(_between(name, *pair, unit_of.get(name, "")) for name, pair in named)
    else:
        yield f"true positions: entries of the matrices from {_list(positions['low'])} to {_list(positions['high'])}"
    speeds, errors = of.domain.names[-3 * n : -2 * n], of.domain.names[-2 * n : -n]
    yield "true velocities up to: " + _up_to(speeds, of.velocity, unit_of)
    yield "errors of the estimated position up to: " + _up_to(errors, of.domain.high[-2 * n : -n], unit_of)
    inputs = of.given["inputs"]
    pairs = enumerate(zip(inputs["low"], inputs["high"], strict=True), start=1)
    yield f"inputs: {', '.join(_between(f'u{i}', *pair, '') for i, pair in pairs) or 'none'}"
    first, last = of.given["times"]
    yield f"times: {_exact(first)} to {_exact(last)} s" + (
        ", or any, where the force does not read them" if first == last else ""
    )
    yield f"errors of the measured position up to: {_list(of.given['noise'])}"
    yield f"unknown forces up to: {_list(of.given['disturbance'])}"
    yield f"domain of the proofs: {of.domain}"


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
    last = math.floor(math.log10(abs(value))) - 3
    return f"{float(text) - 10.0**last:.4g}"
