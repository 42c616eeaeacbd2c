"""Writes the statement of a proof of contraction: its claim in words with all numbers, and its hypotheses."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from covariant.certificates.base._assumed import ASSUMED, ASSUMED_WITH_SAMPLES
from covariant.certificates.base._claims import CLAIMS, MissingClaim, PredictionClaim, RemainderClaim, Terms, select
from covariant.certificates.base._document import Document, Resolved
from covariant.certificates.base._intrinsic import observer_document, signals_of
from covariant.certificates.base._properties import EVERYWHERE, PERIODIC, SYMMETRIC, configuration_names, true_region
from covariant.certificates.base._remainder import gain_length
from covariant.certificates.base._sampling import Sampling
from covariant.certificates.base._start import start_of
from covariant.certificates.base._statement import Evidence, Hypothesis, Statement, exact, rounded_down
from covariant.models import recipe_text


def contraction_statement(of: Resolved, evidence: Evidence, checker: Hypothesis | None = None) -> Statement:
    """Write the statement of a proof, with its verdict."""
    document = of.document
    hypotheses = (*_hypotheses(of, evidence), *(() if checker is None else (checker,)), *_assumptions(document))
    counterexample = next((c.proof.counterexample for c in document.claims if c.proof.counterexample is not None), None)
    point = () if counterexample is None else tuple(counterexample.mean(axis=0).tolist())
    draft = Statement("", (), hypotheses, document.rate, str(of.domain), point)
    # There is no tube without a proof, so its radius is not printed.
    data = tuple(_description(of, document.radius if draft.verdict == "holds" else 0.0))
    claim = f"squared lengths shrink at {document.rate:.4g} 1/s or faster on the region"
    if draft.verdict == "holds":
        claim = _converges(document)
    if draft.verdict == "undecided":
        reasons = [h.place for h in hypotheses if h.verdict == "undecided" and h.place]
        claim += f"; {reasons[0]}" if reasons else ""
    return draft._replace(claim=claim, about=data)


def _converges(document: Document) -> str:
    speeds, conditions = ", ".join(f"{v:.4g}" for v in document.velocity), []
    given = document.given
    for bounds, label in ((given.noise, "measurement errors"), (given.disturbance, "unknown forces")):
        if bounds.any():
            conditions.append(f"{label} up to {', '.join(f'{bound:.4g}' for bound in bounds)}")
    end = f" to {document.steady:.4g} or less" if document.steady else ""
    if document.remainder.rate:
        end = f", which approaches {rounded_down(document.rate / 2)} 1/s"
    if document.sampling is not None:
        conditions.append(_samples(document.sampling))
    return (
        f"estimates within {rounded_down(document.radius)} of a solution with velocities up to {speeds} stay so, and "
        f"their distance falls at {rounded_down(document.decay)} 1/s or faster{end}"
        + (f", under {' and '.join(conditions)}" if conditions else "")
    )


def _samples(sampling: Sampling) -> str:
    """Describe in words when measurements come."""
    shortest, longest = (exact(h) for h in sampling.interval)
    every = f"samples {shortest} s apart" if shortest == longest else f"samples {shortest} to {longest} s apart"
    if not sampling.lost:
        return f"{every}, of which none is lost"
    as_rows = (
        f"as rows that may be missing: one prediction may cover {sampling.oldest:.6g} s"
        if sampling.missing_rows
        else "each of them as a row without a measurement, over which the observer predicts"
    )
    return f"{every}, of which at most {sampling.lost} in a row are lost, {as_rows}"


def _hypotheses(facts: Resolved, evidence: Evidence) -> Iterator[Hypothesis]:
    document, names = facts.document, facts.domain.names
    n, start = len(document.velocity), document.first_velocity
    # Errors of the position come first, then the velocities.
    entries = (*names[start + n : start + 2 * n], *names[start : start + n])
    terms = Terms(document.rate, document.radius, document.sampling, entries)
    yield from (claim.hypothesis(terms, evidence) for claim in document.claims)
    if all(claim.proof.verdict == "holds" for claim in document.claims):
        if exact := select(document.claims, RemainderClaim):
            yield _remainder(document, evidence)
        if document.radius or not exact:
            yield _radius(document, evidence)
        if select(document.claims, MissingClaim):
            yield _factor(document, evidence)
        if select(document.claims, PredictionClaim):
            yield _steps(document, evidence)
    if document.sampling is None:
        text = "over these positions, inputs and times the force stays within the bounds of the domain"
        yield Hypothesis(text, evidence)
    if document.driven:
        last = slice(-len(document.driven), None)
        held = zip(*(each[last] for each in (names, document.low, document.high, facts.domain.units)), strict=True)
        ranges = ", ".join(_range_line(*each) for each in held)
        yield Hypothesis(
            f"friction depends on no other signals than these, whose values the domain contains: {ranges}", evidence
        )
    if document.sampling is not None or document.joint_friction:
        read, acting = ("velocities", "friction") if document.sampling is None else ("inputs and velocities", "forces")
        text = f"over these {read}, {acting} and the slopes of friction stay within the bounds of the domain"
        yield Hypothesis(text, evidence)
    model = facts.observer.model
    if not model.manifold.commuting:
        yield Hypothesis(SYMMETRIC, evidence)
    elif model.circles:
        yield Hypothesis(PERIODIC, evidence)
    positions = true_region(model, document.given.positions)
    free = [name for name, low in zip(configuration_names(model), positions[0], strict=True) if low == -np.inf]
    if free and model.manifold.commuting:
        yield Hypothesis(EVERYWHERE.format(", ".join(free)), evidence)
    text = "the errors are below half a turn, so that the shortest path to the measurement is unique"
    yield Hypothesis(text, evidence)
    described = "flow" if document.sampling is None else "prediction and correction"
    text = f"the observer is {type(facts.observer).__name__} itself, whose {described} is the one described"
    yield Hypothesis(text, evidence)


def _assumptions(document: Document) -> Iterator[Hypothesis]:
    always = ASSUMED if document.sampling is None else ASSUMED_WITH_SAMPLES
    yield from (Hypothesis(line, "assumed") for line in always)
    if document.radius and select(document.claims, RemainderClaim):
        yield Hypothesis(_geodesic(document), "assumed")
    if document.sampling is not None:
        absent = (kind for kind in CLAIMS.values() if kind.assumed_without and not select(document.claims, kind))
        yield from (Hypothesis(kind.assumed_without, "assumed") for kind in absent)


def _remainder(document: Document, evidence: Evidence) -> Hypothesis:
    """That the exact observer converges where its approximation does, on what is left of the rate."""
    text = "the exact observer differs little enough from its approximation (5), which is proved to contract"
    if document.radius:
        text += f": of {document.rate / 2:.4g} 1/s it leaves {rounded_down(document.decay)} 1/s"
        return Hypothesis(text, evidence, margin=document.decay)
    reason = (
        "the exact observer may differ too much from its approximation (5), by tensors whose bounds are above; ask for "
        "a higher rate, give a smaller velocity, error, position or input, or certify Intrinsic"
    )
    return Hypothesis(text, evidence, "undecided", None, reason)


def _geodesic(document: Document) -> str:
    """What is assumed of the geodesics that the exact observer finds."""
    gain = gain_length((document.observer["alpha"], document.observer["beta"]), document.q)
    return (
        f"the geodesics that the observer finds are shorter than {document.remainder.distance:.4g}, as `info.distance` "
        "tells (then each is the shortest one), and exact: `info.residual` tells by how much one misses, and by the "
        f"gains an error r of its logarithm adds {gain:.4g} r to the flow"
    )


def _factor(document: Document, evidence: Evidence) -> Hypothesis:
    """State that the correction that runs, with its factor, is close to the proved one, and never restarts."""
    loss = document.loss
    text = "the factor 1/(1 + s/18) of the correction that runs leaves a positive rate, and no sample restarts it"
    if loss.allowed(document.rate):
        return Hypothesis(f"{text}: it takes {loss.rate:.2g} 1/s", evidence, margin=document.decay)
    reason = (
        f"the factor takes up to {loss.rate:.4g} 1/s of {document.rate / 2:.4g} 1/s, and s is up to {loss.restart:.4g} "
        "of where a sample restarts the estimate; make the interval shorter"
    )
    return Hypothesis(text, evidence, "undecided", None, reason)


def _steps(document: Document, evidence: Evidence) -> Hypothesis:
    """State that errors of the Runge–Kutta steps alone do not lead out of the tube."""
    text = "the errors of the Runge–Kutta steps of predictions do not lead out of the tube"
    if document.drift < document.radius:
        text += f": alone they lead at most {document.drift:.2g} away"
        return Hypothesis(text, evidence, margin=document.radius - document.drift)
    reason = f"alone they may lead {document.drift:.4g} away, out of the tube; use more substeps or a shorter interval"
    return Hypothesis(text, evidence, "undecided", None, reason)


def _radius(document: Document, evidence: Evidence) -> Hypothesis:
    """State that the tube exists, and that noise does not lead out of it."""
    if document.radius > document.steady:
        text = "the tube has a radius, and noise and unknown forces alone do not lead out of it"
        return Hypothesis(text, evidence, margin=document.radius - document.steady)
    reason = f"noise and disturbance alone lead {document.steady:.4g} away, out of the tube; make them smaller"
    return Hypothesis("noise and unknown forces alone do not lead out of the tube", evidence, "undecided", None, reason)


def _description(facts: Resolved, radius: float) -> Iterator[str]:
    """Lines with all data that are needed to repeat the proof."""
    document, model = facts.document, facts.observer.model
    n, given = len(document.velocity), document.given
    fields, unit_of = observer_document(facts.observer), dict(zip(facts.domain.names, facts.domain.units, strict=True))
    kind, frame = fields.pop("kind"), fields.pop("frame")
    alpha, beta = (exact(fields.pop(name)) for name in ("alpha", "beta"))
    options = "".join(f", {name} = {value}" for name, value in fields.items())
    yield f"model: {'one that was given as an object' if document.recipe is None else recipe_text(document.recipe)}"
    gains = f"alpha = {alpha} 1/s, beta = {beta} 1/s²"
    yield f"observer: {kind} in the frame of {frame}, {gains}{options}; {_time(document)}"
    yield from _metric(document)
    if radius:
        rate = document.rate if document.sampling is None else 2 * document.decay
        right_after = "" if document.sampling is None else " right after a measurement"
        lengths = f"rate λ = {rounded_down(rate)} 1/s of squared lengths"
        yield f"{lengths}, radius ε = {rounded_down(radius)} in this metric{right_after}"
    start = start_of(radius, facts.domain, document.claims) if radius else None
    if start is not None:
        yield f"errors of a start that are within ε, all at once: {start}"
    named = [*zip(configuration_names(model), *true_region(model, given.positions).tolist(), strict=True)]
    ranges = [_range_line(name, low, high, unit_of.get(name, "")) for name, low, high in named if low > -np.inf]
    free = [name for name, low, _ in named if low == -np.inf]
    anywhere = [f"any {', '.join(free)}, on which nothing depends"] * bool(free)
    yield f"true positions: {', '.join([*ranges, *anywhere]) if ranges else 'any, since nothing depends on them'}"
    first = document.first_velocity
    speeds, errors = slice(first, first + n), slice(first + n, first + 2 * n)
    yield "true velocities up to: " + _up_to(facts.domain.names[speeds], document.velocity, unit_of)
    off = _up_to(facts.domain.names[errors], facts.domain.high[errors], unit_of)
    yield f"errors of the estimated position up to: {off}"
    named = zip(*(each[1:] for each in signals_of(model)), *given.inputs.tolist(), strict=True)
    yield f"inputs: {', '.join(_range_line(name, low, high, unit) for name, unit, low, high in named) or 'none'}"
    first, last = given.times
    unread = ", or any, where neither force nor friction reads them" if first == last else ""
    yield f"times: {exact(first)} to {exact(last)} s{unread}"
    yield f"errors of the measured position up to: {_list(given.noise)}"
    yield f"unknown forces up to: {_list(given.disturbance)}"
    yield f"domain of the proofs: {facts.domain}"


def _time(document: Document) -> str:
    if document.sampling is None:
        return "continuous time"
    substeps = document.sampling.substeps
    count = "as many Runge–Kutta steps as it chooses" if substeps is None else f"{substeps} Runge–Kutta steps"
    return f"predictions in {count} between {_samples(document.sampling)}"


def _metric(document: Document) -> Iterator[str]:
    if document.sampling is None:
        yield f"metric: Q = {_rows(document.q)}"
        return
    terms = [_rows(document.q), *(f"{_rows(r)} τ^{k}" for k, r in enumerate(document.sampling.slopes, start=1))]
    sheared = ", in a frame that is sheared with τ" if document.sampling.shear else ""
    yield f"metric: R(τ) = {' + '.join(terms)} at the age τ of the last measurement{sheared}"


def _range_line(name: str, low: float, high: float, unit: str) -> str:
    return f"{name} {exact(low)} to {exact(high)} {unit}".rstrip()


def _up_to(names: Sequence[str], bounds: Sequence[float] | np.ndarray, units: dict[str, str]) -> str:
    return ", ".join(f"{name} {exact(b)} {units[name]}".rstrip() for name, b in zip(names, bounds, strict=True))


def _rows(matrix: np.ndarray) -> str:
    return _list([_list(row) for row in np.asarray(matrix).tolist()])


def _list(values: Sequence[Any] | np.ndarray) -> str:
    return "[" + ", ".join(v if isinstance(v, str) else exact(v) for v in values) + "]"
