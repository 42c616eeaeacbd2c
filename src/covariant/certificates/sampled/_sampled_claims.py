"""Proves the claims of a certificate of the sampled step, and searches its metric again if a proof fails."""

import dataclasses
import functools
import math
import typing
from collections.abc import Callable, Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant._domains import SPAN, Domain
from covariant._typing import Numbers
from covariant.certificates.base import (
    MOST_LOST,
    UNPROVED,
    AbstractClaim,
    ContractionClaim,
    CorrectionClaim,
    DisturbanceClaim,
    Effort,
    ErrorSystem,
    Given,
    Intrinsics,
    Loss,
    MissingClaim,
    PredictionClaim,
    Recursion,
    Sampling,
    TwoByTwo,
    contraction,
    correction,
    joint_force_bound,
    missing_bound,
    reach_squares,
    select,
    unit_reach,
)
from covariant.certificates.sampled._prediction import ORDER, defect_bound
from covariant.certificates.sampled._sampled_metric import Found, SampledMetric, random_points
from covariant.certificates.sampled._sampled_step import sampled_prediction, sampled_system
from covariant.observers import Intrinsic
from scalargraph import Lowered, numbers
from scalargraph.errors import InputError
from scalargraph.proofs import LETTERS, Box, Form, Proof

LostRows = Literal["empty", "missing"]
LOST_ROWS = typing.get_args(LostRows)
STAMP_MARGIN = 1e-3
"""Fraction by which an interval is proved wider at both ends, since stamps are rounded: times since 1970 in doubles to
2.4e-7 s, and many logs to a microsecond."""
SEARCHES = 4
"""Number of repeated searches of the metric, with the counterexamples of a proof."""
WIDER, TINY = (64.0, 16.0, 4.0, 2.0, 1.3), 1e-12
"""Margins on sampled squares, so that they can be proved quickly, and a square that replaces zero."""
MUCH_WIDER = (1e6, 1e5, 1e4, 1e3, 250.0)
"""The same margins for errors of Runge–Kutta steps, which are often much smaller than relevant."""
LITTLE, PART = 0.02, 0.25
"""Fraction of the rate that a wider bound may take, and a larger one if the first is too little. The square of the
first is the fraction of the radius for errors of predictions."""
PREDICTION_WORK = 4_000_000
"""Largest number of boxes for the errors of Runge–Kutta steps, times the number of operations of their matrix: some
hundred for a pendulum, and thirty thousand for a heavy top."""
LOWER_ORDERS, STEEP_WORK = (4, 2, 1, 0), 60
"""Orders of the bound that are tried in turn if the first one fails, and the number of operations per remaining box
that each may take: steep friction needs small boxes near rest."""
POINTS = 2000
"""Number of points at which the squares are sampled."""
ENOUGH = 0.5
"""Margin of a metric without shear, as a fraction of the rate, below which a metric with shear is also tried."""


LOST = Domain(f"be a whole number from 0 to {MOST_LOST}", lambda a: (a >= 0) & (a <= MOST_LOST), whole=True)
"""Numbers of samples that may be lost in a row."""


def check_sampling(
    observer: Intrinsics,
    interval: tuple[float, float],
    lost: int,
    lost_rows: LostRows,
    q: Numbers | None,
    n: int,
) -> Sampling:
    """Check the arguments of `certify` that concern samples."""
    if type(observer) is not Intrinsic:
        raise TypeError(f"certify: interval is for Intrinsic alone; got {type(observer).__name__}")
    shortest, longest = check_interval(interval, lost, lost_rows)
    if q is not None:
        raise InputError("certify: with interval the metric is searched; leave q out")
    # Six variables per coordinate and the age; on rotations up to nine entries and five variables per velocity.
    most = (len(LETTERS) - 1) // 6
    if n > most:
        raise InputError(f"certify: with interval at most {most} coordinates are covered; got {n}")
    ends = np.array([shortest * (1 - STAMP_MARGIN), longest * (1 + STAMP_MARGIN)])
    return Sampling(ends, lost, np.zeros((0, 2, 2)), False, observer.substeps, lost_rows == "missing")


def check_interval(interval: tuple[float, float], lost: int, lost_rows: LostRows) -> tuple[float, float]:
    """Check the times between samples, and return the shortest and the longest [s]."""
    SPAN.check("certify", "interval", interval)
    LOST.check("certify", "lost", lost)
    if lost_rows not in LOST_ROWS:
        raise InputError(f"certify: lost_rows must be one of {', '.join(LOST_ROWS)}; got {lost_rows!r}")
    return float(interval[0]), float(interval[1])


def sampled_claims(
    observer: Intrinsics,
    sampling: Sampling,
    rates: Sequence[float],
    q: TwoByTwo,
    noise: Float[np.ndarray, "n"],
    domain_of: Callable[[ErrorSystem], Box],
    effort: Effort,
) -> tuple[float, TwoByTwo, Sampling, ErrorSystem, Box, list[AbstractClaim]]:
    """Search a metric, and prove that flow and correction contract it."""
    domain = domain_of(sampled_system(observer, q, sampling))
    effort.report("searching the metric", 0.0, 0)
    search, metric = _search(observer, sampling, rates, noise, domain)
    rate = search.rate
    # The ratio of position and velocity errors depends on the metric, and the region on this ratio: search twice.
    domain = domain_of(sampled_system(observer, metric.q, search.sampling._replace(slopes=metric.slopes)))
    effort.domain = domain
    for search_again in (*[True] * SEARCHES, False):
        metric = search.solve(domain)
        sampling = search.sampling._replace(slopes=metric.slopes)
        system = sampled_system(observer, metric.q, sampling)
        claims = _prove(system, sampling, rate, effort, noise, metric.squares)
        wrong = _counterexamples(claims)
        if not (wrong and search_again) or metric.margin <= 0:
            return rate, metric.q, sampling, system, domain, claims
        search.add(wrong)
    raise AssertionError


def _search(
    observer: Intrinsics, sampling: Sampling, rates: Sequence[float], noise: Float[np.ndarray, "n"], domain: Box
) -> tuple[SampledMetric, Found]:
    """The metric with the largest margin, or with noise the smallest bound, with or without shear."""
    search = SampledMetric(observer, sampling, rates[0], noise)
    if not noise.any():
        metric = search.solve(domain)
        if metric.margin < ENOUGH * search.rate:
            sheared = SampledMetric(observer, sampling._replace(shear=True), search.rate, noise)
            other = sheared.solve(domain)
            if other.margin > metric.margin:
                return sheared, other
        return search, metric
    best, metric = search, Found(q=np.eye(2), slopes=np.zeros((0, 2, 2)), margin=-np.inf)
    for each in (search, SampledMetric(observer, sampling._replace(shear=True), rates[0], noise)):
        for rate in rates:
            other = each.at_rate(rate)
            found = other.solve(domain)
            if metric.margin <= 0 or (found.margin > 0 and found.velocity < metric.velocity):
                best, metric = other, found
    return best, metric


def _counterexamples(claims: Sequence[AbstractClaim]) -> list[tuple[bool, np.ndarray]]:
    """For each refuted claim, whether it concerns a correction, and the point (d,)."""
    wrong: list[tuple[bool, np.ndarray]] = []
    for claim in claims:
        if claim.proof.counterexample is not None:
            wrong.append((isinstance(claim, CorrectionClaim), claim.proof.counterexample.mean(axis=0)))
    return wrong


def _prove(
    system: ErrorSystem,
    sampling: Sampling,
    rate: float,
    effort: Effort,
    noise: Float[np.ndarray, "n"],
    squares: Sequence[Float[np.ndarray, "k"]],
) -> list[AbstractClaim]:
    """The claims on flow and correction; after the first one that does not hold, the others are not tried."""

    def matrix(claim: CorrectionClaim) -> Form:
        return correction(system, noise if claim.squares else None, claim.squares)

    def larger(claim: CorrectionClaim, point: np.ndarray) -> CorrectionClaim:
        return dataclasses.replace(claim, squares=tuple(1.2 * s for s in claim.squares))

    claims: list[AbstractClaim] = [ContractionClaim(effort.prove("contraction", contraction(system, rate)))]
    for lost in range(sampling.lost + 1):
        if claims[-1].proof.verdict != "holds":
            break
        claim = CorrectionClaim(UNPROVED, lost, tuple(np.asarray(squares[lost]).tolist()) if noise.any() else ())
        domain = _domain_of(claim, effort.domain, len(noise), sampling)
        tries = SEARCHES if claim.squares else 0
        claims.append(effort.prove_claim(f"correction after {lost} lost", claim, matrix, larger, tries, domain))
    return claims


def _domain_of(claim: AbstractClaim, domain: Box, n: int, sampling: Sampling) -> Box:
    """The box of one claim, from the box of the certificate."""
    low, high = claim.bounds(domain.low, domain.high, n, sampling)
    return Box(*claim.variables(domain.names, domain.units, n), low, high)


def prediction_claims(
    observer: Intrinsics,
    sampling: Sampling,
    q: TwoByTwo,
    rate: float,
    given: Given,
    claims: Sequence[AbstractClaim],
    radius: float,
    effort: Effort,
) -> list[AbstractClaim]:
    """Prove a bound of the errors of the Runge–Kutta steps of predictions."""
    missing = select(claims, MissingClaim)[0]
    left = Loss.of(sampling, q, rate, missing.square, missing.limit).allowed(rate)
    if sampling.substeps is None or not radius > 0 or not left:
        return []
    prediction = sampled_prediction(observer, q, sampling)
    if not prediction.has_series:
        return []
    domain = _domain_of(PredictionClaim(UNPROVED, 0.0), effort.domain, prediction.size // 2, sampling)
    points = random_points(np.random.default_rng(0), domain, POINTS)

    def drift(square: float, order: int = ORDER, bounds: Given | None = None) -> float:
        claim = PredictionClaim(UNPROVED, square, order)
        return Recursion.of(sampling, q, rate, bounds, [*claims, claim]).steady

    def prove_bound(square: float, order: int = ORDER, work: int = PREDICTION_WORK) -> PredictionClaim:
        bound, boxes = defect_bound(prediction, square, order), work // len(graph_of(order).graph.nodes)
        return PredictionClaim(_prove_with_boxes(effort, bound, domain, boxes), square, order)

    @functools.cache
    def graph_of(order: int) -> Lowered:
        return defect_bound(prediction, 1.0, order).graph(jnp.asarray(points[0])).entries

    least = _largest_squared_length(graph_of(ORDER), points)
    squares = [factor * max(least, TINY) for factor in (*MUCH_WIDER, *WIDER)]
    bounded = drift(squares[-1]) < radius
    if bounded:
        # The widest bound that changes the estimate little within the tube needs the fewest boxes.
        square = next((each for each in squares if drift(each) < LITTLE**2 * radius), squares[-1])
        claim = prove_bound(square)
        if claim.proof.verdict == "holds":
            return [claim]
    # Friction that is steep at rest has large derivatives there. Lower orders avoid them; uniform points miss them.
    slow, n = points.copy(), prediction.size // 2
    # After the velocities come the force of the input, the age and two lengths of a step.
    slow[:, -2 * n - 3 : -n - 3] *= 10.0 ** np.random.default_rng(1).uniform(-3, 0, (POINTS, n))
    for order in LOWER_ORDERS:
        least = max(_largest_squared_length(graph_of(order), slow), TINY)
        # The drift by Runge–Kutta steps is proportional to their bound.
        square = least * (PART * radius / drift(least, order)) ** 2
        if square > WIDER[-1] * least and drift(square, order, given) < radius:
            claim = prove_bound(square, order, STEEP_WORK * effort.boxes)
            if claim.proof.verdict == "holds":
                return [claim]
    if bounded:
        return []
    # The defect itself, at the end of the longest step.
    points[:, -2:] = sampling.longest_step
    if drift(_largest_squared_length(graph_of(0), points) / sampling.longest_step**8) < radius:
        return []
    return [prove_bound(squares[-1])]


def _largest_squared_length(matrix: Lowered, points: np.ndarray) -> float:
    """The largest squared length of the vector of a matrix [[1, vᵀN], [Nv, N]] at some points."""
    entries = np.asarray(numbers(matrix, points))
    size = math.isqrt(entries.size // len(points))
    matrices = entries.reshape(-1, size, size)
    pulled = matrices[:, 1:, :1]
    return float((pulled * np.linalg.solve(matrices[:, 1:, 1:], pulled)).sum((1, 2)).max())


def _prove_with_boxes(effort: Effort, bound: Form, domain: Box, boxes: int) -> Proof:
    """A proof with a part of the remaining boxes, so that a proof that is too hard takes no more."""
    left = effort.boxes
    effort.boxes = min(left, boxes)
    proof = effort.prove("predictions", bound, domain)
    effort.boxes = max(left - proof.boxes, 0)
    return proof


def force_claim(system: ErrorSystem, disturbance: Float[np.ndarray, "n"], effort: Effort) -> DisturbanceClaim:
    """Prove a bound of the amount that an unknown force adds to the flow between samples."""
    rng = np.random.default_rng(0)
    graph = joint_force_bound(system, disturbance, 0.0).graph(jnp.asarray(effort.domain.high)).entries
    n = len(disturbance)
    values = np.asarray(numbers(graph, random_points(rng, effort.domain, POINTS))).reshape(-1, n, n)
    # With square = 0 the matrix is −BᵀMB.
    square = WIDER[-1] * -float(np.linalg.eigvalsh(values).min())
    return effort.prove_claim(
        "unknown forces",
        DisturbanceClaim(UNPROVED, square),
        lambda claim: joint_force_bound(system, disturbance, claim.square),
        lambda claim, point: dataclasses.replace(claim, square=2 * claim.square),
        SEARCHES,
    )


def missing_claims(
    observer: Intrinsics,
    system: ErrorSystem,
    sampling: Sampling,
    q: TwoByTwo,
    rate: float,
    claims: Sequence[AbstractClaim],
    effort: Effort,
) -> list[AbstractClaim]:
    """Prove a bound of the acceleration that a prediction omits, and of the position error."""
    if isinstance(observer, Intrinsic) and observer.order != 1:
        return []
    reach = unit_reach(reach_squares(claims))
    n = len(reach)
    domain = _domain_of(MissingClaim(UNPROVED, 0.0, 0.0), effort.domain, n, sampling)
    # With square = 1 and limit = 0 the first block is g − DᵀgD, and the last −WgW.
    graph = missing_bound(system, 1.0, 0.0, reach).graph(jnp.asarray(domain.high)).entries
    blocks = np.asarray(numbers(graph, random_points(np.random.default_rng(0), domain, POINTS)))
    blocks = blocks.reshape(-1, 3 * n, 3 * n)
    weighted = -blocks[:, 2 * n :, 2 * n :]
    metric = weighted / np.outer(reach, reach)
    inner = np.linalg.inv(np.linalg.cholesky(metric))
    ratio = inner @ (metric - blocks[:, :n, :n]) @ np.swapaxes(inner, 1, 2)
    square, length = (float(np.linalg.eigvalsh(each)[:, -1].max()) for each in (ratio, weighted))
    limit = math.sqrt(WIDER[-1] * n * length)
    squares = [factor * max(square, TINY) for factor in WIDER]
    # The widest bound with a small loss of rate needs the fewest boxes; if there is none, a larger loss is accepted.
    shares = [Loss.of(sampling, q, rate, each, limit).rate / (rate / 2) for each in squares]
    affordable = [each for part in (LITTLE, PART) for each, share in zip(squares, shares, strict=True) if share < part]
    square = affordable[0] if affordable else squares[-1]
    claim = effort.prove_claim(
        "what predictions lack",
        MissingClaim(UNPROVED, square, limit),
        lambda claim: missing_bound(system, claim.square, claim.limit, reach),
        lambda claim, point: dataclasses.replace(claim, square=2 * claim.square, limit=2 * claim.limit),
        SEARCHES,
        domain,
    )
    return [claim]
