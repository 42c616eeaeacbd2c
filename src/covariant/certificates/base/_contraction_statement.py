"""The statement of a proof of contraction: its claim in words with all numbers, and its hypotheses."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates.base._assumed import ASSUMED, ASSUMED_WITH_SAMPLES, PREDICTIONS, SMOOTH_FACTOR
from covariant.certificates.base._claims import Claim, claimed_drift, loss_of, plain_bounds, stated_claims, steady_of
from covariant.certificates.base._document import Document, first_velocity
from covariant.certificates.base._error_system import ErrorSystem
from covariant.certificates.base._intrinsic import Intrinsics, observer_document
from covariant.certificates.base._sampling import Loss, Sampling
from covariant.certificates.base._start import start_of
from covariant.certificates.base._statement import Evidence, Hypothesis, Statement
from covariant.certificates.base._tangent_metric import TwoByTwo
from covariant.models import recipe_text
from covariant.proofs import Box


class Contraction(NamedTuple):
    """All that a statement about an intrinsic observer is derived from.

    Attributes:
        rate, radius, observer, q, domain, velocity, given, claims, recipe, sampling: as in `ContractionCertificate`.
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
    sampling: Sampling | None = None

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
            document.sampling,
        )

    @property
    def loss(self) -> Loss:
        """What the factor of the correction that runs takes from the rate."""
        return loss_of(self.sampling, self.q, self.rate, self.claims)

    @property
    def decay(self) -> float:
        """Rate [1/s] at which distances decrease."""
        return self.rate / 2 - self.loss.rate

    @property
    def first_velocity(self) -> int:
        """Index of the first velocity in the domain, after the coordinates, which on a group are none."""
        return first_velocity(len(self.domain.names), len(self.velocity), self.sampling is not None)

    @property
    def steady(self) -> float:
        """The distance to which noise and disturbance alone may lead."""
        return steady_of(self.sampling, self.q, self.rate, self.given, self.claims)

    @property
    def drift(self) -> float:
        """The distance to which errors of Runge–Kutta steps alone may lead; 0 where no claim bounds them."""
        return claimed_drift(self.sampling, self.q, self.rate, self.claims)


def contraction_statement(of: Contraction, evidence: Evidence, checker: Hypothesis | None = None) -> Statement:
    """Write the statement of a proof, with its verdict.

    Args:
        of: what was proved.
        evidence: that of the claims, "proved" or "claimed" by a file.
        checker: the result of the checker, as from `judged`; None where it did not run.

    Returns:
        The statement, with the rate λ [1/s] of squared lengths as margin.
    """
    hypotheses = (*_hypotheses(of, evidence), *(() if checker is None else (checker,)), *_assumed(of))
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
    if facts.sampling is not None:
        conditions.append(_samples(facts.sampling))
    return (
        f"estimates within {_down(facts.radius)} of a solution with velocities up to {speeds} stay so, and their "
        f"distance falls at {_down(facts.decay)} 1/s or faster{end}"
        + (f", under {' and '.join(conditions)}" if conditions else "")
    )


def _samples(sampling: Sampling) -> str:
    """When measurements come, in words."""
    shortest, longest = (_exact(h) for h in sampling.interval)
    every = f"samples {shortest} s apart" if shortest == longest else f"samples {shortest} to {longest} s apart"
    return f"{every}, of which at most {sampling.lost} in a row are lost"


def _hypotheses(facts: Contraction, evidence: Evidence) -> Iterator[Hypothesis]:
    n, names, start = len(facts.velocity), facts.domain.names, facts.first_velocity
    between = "" if facts.sampling is None else " between samples"
    for claim in facts.claims:
        proof, reach = claim.proof, facts.radius * math.sqrt(claim.square)
        if claim.kind == "contraction":
            text, margin = (
                f"squared lengths shrink at {_exact(facts.rate)} 1/s or faster{between} everywhere in the domain",
                None,
            )
        elif claim.kind == "reach":
            # Errors of the position come first, then the velocities.
            name = names[start + n + claim.row] if claim.row < n else names[start - n + claim.row]
            text = f"a curve of the length of the radius reaches less than {claim.limit:.4g} far in {name}"
            margin = claim.limit - reach if facts.radius else None
        elif claim.kind == "correction" and facts.sampling is not None:
            first, last = (_exact(h) for h in facts.sampling.ages[claim.row])
            text = f"the correction by a measurement that is {first} to {last} s old lengthens no curve"
            if claim.squares:
                text += f", and its error adds at most {_up(math.fsum(claim.squares))} to a squared length"
            margin = None
        elif claim.kind == "prediction":
            text, margin = "the defect of the Runge–Kutta steps of a prediction keeps its bound", None
        elif claim.kind == "start":
            text, margin = "errors within the bounds of a start are no longer than the radius", None
        elif claim.kind == "missing":
            text, margin = "the acceleration that a prediction lacks, and the position error, keep their bounds", None
        else:
            text, margin = "noise and unknown forces add no more to the flow than the radius allows", None
        yield Hypothesis(text, evidence, proof.verdict, margin, proof.reason)
    if all(claim.proof.verdict == "holds" for claim in facts.claims):
        yield _radius(facts, evidence)
        if any(claim.kind == "missing" for claim in facts.claims):
            yield _factor(facts, evidence)
        if any(claim.kind == "prediction" for claim in facts.claims):
            yield _steps(facts, evidence)
    if facts.sampling is None:
        yield Hypothesis(
            "over these positions, inputs and times the force stays within the bounds of the domain", evidence
        )
    if facts.sampling is not None or len(facts.domain.names) > 4 * n:
        acting = "forces" if facts.sampling is not None else "friction"
        yield Hypothesis(
            f"over these {'inputs and ' if facts.sampling is not None else ''}velocities, {acting} and the slopes of "
            "friction stay within the bounds of the domain",
            evidence,
        )
    yield Hypothesis(
        "the errors are below half a turn, so that the shortest path to the measurement is unique", evidence
    )
    described = "flow" if facts.sampling is None else "prediction and correction"
    yield Hypothesis(
        f"the observer is {type(facts.observer).__name__} itself, whose {described} is the one described", evidence
    )


def _assumed(facts: Contraction) -> Iterator[Hypothesis]:
    yield from (Hypothesis(line, "assumed") for line in (ASSUMED if facts.sampling is None else ASSUMED_WITH_SAMPLES))
    if facts.sampling is not None:
        kinds = {claim.kind for claim in facts.claims}
        more = (("prediction", PREDICTIONS), ("missing", SMOOTH_FACTOR))
        yield from (Hypothesis(line, "assumed") for kind, line in more if kind not in kinds)


def _factor(facts: Contraction, evidence: Evidence) -> Hypothesis:
    """That the correction that runs, with its factor, is close to the one that is proved, and never restarts."""
    loss = facts.loss
    text = "the factor 1/(1 + s/18) of the correction that runs leaves a positive rate, and no sample restarts it"
    if loss.allowed(facts.rate):
        return Hypothesis(f"{text}: it takes {loss.rate:.2g} 1/s", evidence, margin=facts.decay)
    reason = (
        f"the factor takes up to {loss.rate:.4g} 1/s of {facts.rate / 2:.4g} 1/s, and s is up to {loss.restart:.4g} of "
        "where a sample restarts the estimate; make the interval shorter"
    )
    return Hypothesis(text, evidence, "undecided", None, reason)


def _steps(facts: Contraction, evidence: Evidence) -> Hypothesis:
    """That the errors of the Runge–Kutta steps alone do not lead out of the tube."""
    text = "the errors of the Runge–Kutta steps of predictions do not lead out of the tube"
    if facts.drift < facts.radius:
        return Hypothesis(
            f"{text}: alone they lead at most {facts.drift:.2g} away", evidence, margin=facts.radius - facts.drift
        )
    reason = f"alone they may lead {facts.drift:.4g} away, out of the tube; use more substeps or a shorter interval"
    return Hypothesis(text, evidence, "undecided", None, reason)


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
    yield f"observer: {kind} in the frame of {frame}, alpha = {alpha} 1/s, beta = {beta} 1/s²{options}; {_time(facts)}"
    yield from _metric(facts)
    if facts.radius:
        rate = facts.rate if facts.sampling is None else 2 * facts.decay
        right_after = "" if facts.sampling is None else " right after a measurement"
        yield (
            f"rate λ = {_down(rate)} 1/s of squared lengths, radius ε = {_down(facts.radius)} in this metric"
            f"{right_after}"
        )
    factors = [claim.square for claim in facts.claims if claim.kind == "start"]
    if facts.radius and factors:
        squares = [claim.square for claim in facts.claims if claim.kind == "reach"]
        start = start_of(facts.radius, facts.domain, squares, factors[0])
        yield f"errors of a start that are within ε, all at once: {start}"
    positions = facts.given["positions"]
    if model.manifold.commuting:
        ends = zip(positions["low"], positions["high"], strict=True)
        named = zip(model.coordinates, ends, strict=True)
        yield "true positions: " + ", ".join(_between(name, *pair, unit_of.get(name, "")) for name, pair in named)
    else:
        yield f"true positions: entries of the matrices from {_list(positions['low'])} to {_list(positions['high'])}"
    start = facts.first_velocity
    speeds, errors = facts.domain.names[start : start + n], facts.domain.names[start + n : start + 2 * n]
    yield "true velocities up to: " + _up_to(speeds, facts.velocity, unit_of)
    yield "errors of the estimated position up to: " + _up_to(
        errors, facts.domain.high[start + n : start + 2 * n], unit_of
    )
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


def _time(facts: Contraction) -> str:
    if facts.sampling is None:
        return "continuous time"
    substeps = facts.sampling.substeps
    count = "as many Runge–Kutta steps as it chooses" if substeps is None else f"{substeps} Runge–Kutta steps"
    return f"predictions in {count} between {_samples(facts.sampling)}"


def _metric(facts: Contraction) -> Iterator[str]:
    if facts.sampling is None:
        yield f"metric: Q = {_rows(facts.q)}"
        return
    terms = [_rows(facts.q), *(f"{_rows(r)} τ^{k}" for k, r in enumerate(facts.sampling.slopes, start=1))]
    sheared = ", in a frame that is sheared with τ" if facts.sampling.shear else ""
    yield f"metric: R(τ) = {' + '.join(terms)} at the age τ of the last measurement{sheared}"


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


def _up(value: float) -> str:
    """A positive number of four digits that is no smaller."""
    text = f"{value:.4g}"
    if float(text) >= value:
        return text
    last = math.floor(math.log10(abs(value))) - 3
    return f"{float(text) + 10.0**last:.4g}"


def _down(value: float) -> str:
    """A number of four digits that is no larger: what is claimed is never more than what is proved."""
    text = f"{value:.4g}"
    if float(text) <= value:
        return text
    # `.4g` rounds to nearest; one unit of the last of four digits less is below the value.
    last = math.floor(math.log10(abs(value))) - 3
    return f"{float(text) - 10.0**last:.4g}"
