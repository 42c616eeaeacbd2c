"""Proves that an intrinsic observer converges: at which rate, and from within which radius.

Three claims are proved, each over the whole region. First, the flow contracts the metric of the tangent bundle at the
rate λ, whatever the measured trajectory. Second, a curve of length ε changes each position error and each velocity by
no more than the region allows. Third, the force on the system stays within the assumed bounds. Then, as in Theorem 1,
consider any solution whose velocity keeps its bound: an estimate that begins within ε of it stays within ε, and the
distance decreases as `e^(−λt/2)`.

With bounds of the measurement error and of an unmodelled force there is a fourth claim: these errors add to the flow a
vector of length D at most. Then the true motion solves the observer's own flow up to D, so that the distance finally
falls below 2D/λ. If 2D/λ < ε, an estimate within ε stays within ε.

The exact observer (2) is (5) with a disturbance of second order in the error, which reduces the rate; see
`covariant.certificates.base._remainder`.
Source: Aghannan & Rouchon 2003, Theorems 1 and 2, and Fig. 2; Lohmiller & Slotine 1998, section 3.7 for D.
"""

import contextlib
import dataclasses
import functools
import math
import time
import typing
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from covariant._domains import NOT_NEGATIVE, SPAN, Count, Interval, Positive, check_numbers
from covariant._typing import Numbers
from covariant.certificates.base import (
    SPEED,
    UNPROVED,
    AbstractClaim,
    Bounds,
    ContractionClaim,
    DisturbanceClaim,
    Document,
    Effort,
    ErrorSystem,
    Given,
    Intrinsics,
    ReachClaim,
    Region,
    Remainder,
    RemainderClaim,
    Resolved,
    Sampling,
    TwoByTwo,
    amount,
    check_recipe,
    check_unique,
    contraction,
    contraction_statement,
    disturbance_bound,
    disturbance_sizes,
    error_system,
    first_order,
    force_bounds,
    force_slopes,
    need_doubles,
    observer_document,
    reach_squares,
    region_of,
    remainder_bound,
    squared_widths,
    start_claim,
    steady_of,
    width_bound,
)
from covariant.certificates.checking import judged
from covariant.certificates.proving._contraction_certificate import ContractionCertificate
from covariant.certificates.proving._joint_bounds import friction_bounds, has_dry_friction, joint_bounds
from covariant.certificates.proving._rates import metric_and_rates
from covariant.certificates.sampled import (
    LOST,
    LostRows,
    check_sampling,
    force_claim,
    missing_claims,
    prediction_claims,
    sampled_claims,
)
from covariant.models import MechanicalSystem
from covariant.observers import Geodesic
from scalargraph import Lowered, lower, numbers
from scalargraph.errors import InputError
from scalargraph.proofs import MOST_BOXES, Box, check_box

CheckerName = Literal["auto", "all", "off"]
CHECKERS = typing.get_args(CheckerName)
PATIENCE = 10.0
"""Time [s] that the checker gets even if the proof took less."""
SLACK = 1.05
"""Margin on the square of a sampled width, so that the bound can be proved quickly."""
REMAINDER_SLACK = 1.2
"""The same for tensors, of whose bounds a few percent matter less than boxes."""
LEAST_REMAINDER = 1e-4
"""Least square of their bounds: that a tensor vanishes is hard to prove, and nothing is lost by little of it."""
WIDENINGS = 8
"""Number of further tries, with larger squares, of a bound that a counterexample refutes."""


@check_numbers
def certify(
    observer: Intrinsics,
    *,
    velocity: Annotated[ArrayLike, SPEED],
    error: Annotated[ArrayLike, SPEED],
    position: Bounds | None = None,
    input: Bounds | ArrayLike | None = None,
    times: Interval | None = None,
    rate: Positive | None = None,
    q: Numbers | None = None,
    noise: Annotated[ArrayLike, NOT_NEGATIVE] = 0.0,
    disturbance: Annotated[ArrayLike, NOT_NEGATIVE] = 0.0,
    interval: Annotated[tuple[float, float], SPAN] | None = None,
    lost: Annotated[int, LOST] = 0,
    lost_rows: LostRows = "empty",
    recipe: dict[str, Any] | None = None,
    boxes: Count = MOST_BOXES,
    seconds: Positive | None = None,
    processes: Count = 1,
    checker: CheckerName = "auto",
    progress: Callable[[str, float, int], None] | None = None,
) -> ContractionCertificate:
    """Prove that an intrinsic observer converges at a rate, from within a radius, on a region.

    For `Geodesic`, observer (2) of the paper, the contraction of (5) is proved, and how far the two flows differ. The
    radius is then such that at least half of the rate remains, and the rate of closer estimates approaches λ/2. What is
    not proved is that its search finds a geodesic: `info.residual` and `info.distance` tell at run time.

    Use it for an observer that you have built, such as `Intrinsic` with gains of your own; the verb `covariant.certify`
    starts from a model file and designs the gains. Unlike a simulation, the result holds for every motion within the
    bounds. λ is the rate of squared lengths, so errors decrease at λ/2, and the radius is in the metric Q. The effort
    grows steeply with the number of coordinates: begin with a small region. "undecided" does not refute the claim; try
    more boxes or tighter bounds.

    Args:
        observer: the observer, with model and gains: an `Intrinsic`, or a `Geodesic` in coordinates.
        velocity: bound of each true velocity [unit/s], a number or (n,). There is no certificate without it: the tube
            of Theorem 1 shrinks as the velocity grows.
        error: bound of the error of the estimated position [unit], in coordinates or as `log(g⁻¹ g̃)`, a number or
            (n,).
        position: least and largest true positions, (n,) each, or pairs of them by name; on a group the entries of its
            matrices (N, N), named g11, g12, …. Rotations need no bounds, nor do coordinates on which nothing depends.
            Inputs may be bounded by name here too.
        input: bound of each input, a number or (m,), or a pair of bounds; 0 by default. Inputs that the friction
            depends on need bounds.
        times: first and last time [s] of the statement; needed if force or friction depend on time.
        rate: λ [1/s] to prove, of squared lengths. By default it is half of the rate that Q allows at q̂ = q; with
            `interval` it is a tenth of the rate of the gains, and with noise also one to six tenths of it are tried,
            of which the one with the smallest bound of the velocity error is kept.
        q: matrix (2, 2) of the metric; by default the best conditioned one for two thirds of the rate of the gains.
        noise: bound of the error of each measured position [unit], a number or (n,), in coordinates or as `log(q⁻¹ y)`
            in the body frame. If `position` bounds matrix entries on a group, these bounds then apply to the measured
            entries.
        disturbance: bound of each component of an unmodelled force, a number or (n,).
        interval: shortest and longest time [s] between two samples. The statement is then about the observer that
            predicts between samples and corrects at each of them, in a metric found by a search (with clarabel). The
            proved interval is 0.1 % wider at both ends, since stamps are rounded. The force of the system must depend
            on the input alone, in coordinates or on rotations; on rotations without noise and disturbance. Without
            `interval` the observer runs in continuous time.
        lost: with `interval`, the largest number of samples that may be lost in a row.
        lost_rows: whether each lost sample is still a step with NaN as its measurement ("empty"), or whether its row
            may be "missing", so that one step of the observer covers the whole gap, with longer Runge–Kutta steps.
        recipe: the origin of the model, as from `models.recipe`; needed to save the certificate. The statement prints
            it, so it must build the same model.
        boxes: largest number of boxes for all proofs together, which is the same effort on every machine.
        seconds: an additional limit of time [s] for each proof, counted from the moment at which its matrix is
            available as a graph.
        processes: number of processes, as for `prove`.
        progress: called with the name of the proof, the share that is done, and the number of boxes, as for `prove`.
        checker: "auto" runs the checker on the proved claims for as long as the proof took, or for `PATIENCE`; "all"
            runs it to the end; "off" does not run it. The statement says how much it covered; claims that it does not
            accept are "undecided".

    Returns:
        The certificate, whose statement "holds", "fails" or is "undecided".

    Raises:
        ValueError: a required bound is missing; an error is so large that its logarithm is not unique; friction or
            force are not covered, or noise or disturbance of a `Geodesic`; `q` is not symmetric positive definite; the
            recipe is of another model; or `checker` is an unknown word. With `interval`: its times are not positive and
            in order, or `q` is given; without it: samples are lost.
        TypeError: another kind of observer.
        ImportError: with `interval`, the solver clarabel is missing.
    """
    need_doubles("certify")
    if checker not in CHECKERS:
        raise InputError(f"certify: checker must be one of {', '.join(CHECKERS)}; got {checker!r}")
    start = time.monotonic()
    assumed = _check_assumptions(observer, velocity, error, noise, disturbance)
    matrix, target, *slower = metric_and_rates(observer, q, rate, interval is not None, bool(assumed.noise.any()))
    sampling = None
    if interval is not None:
        sampling = check_sampling(observer, interval, lost, lost_rows, q, len(assumed.velocity))
    disturbed = bool(assumed.noise.any() or assumed.disturbance.any())
    if sampling is not None and disturbed and not observer.model.manifold.commuting:
        raise InputError(
            "certify: with interval, noise and disturbance are covered in coordinates only; leave them out"
        )
    if interval is None and (lost or lost_rows != "empty"):
        raise InputError("certify: lost samples need interval, the shortest and longest time between two samples")
    exact = isinstance(observer, Geodesic)
    if exact and disturbed:
        raise InputError(
            "certify: noise and disturbance are not covered for Geodesic; leave them out, or certify Intrinsic"
        )
    region = region_of(observer.model, position, input, times)
    check_recipe(observer.model, recipe)
    effort = Effort(Box((), (), np.zeros(0), np.zeros(0)), boxes, seconds, processes, progress)
    if sampling is None:
        approximate = first_order(observer)
        system, domain, bounds, first = _in_continuous_time(approximate, matrix, target, assumed, region, effort)
        corrections = []
    else:
        # The force depends on the input alone, so that no error of the position changes it.
        bounds = _stated_bounds(region, assumed, np.zeros((len(assumed.velocity),) * 2))
        place = functools.partial(_sampled_domain, observer.model, assumed, region, sampling)
        target, matrix, sampling, system, domain, (first, *corrections) = sampled_claims(
            observer, sampling, [target, *slower], matrix, assumed.noise, place, effort
        )
    claims: list[AbstractClaim] = [first]
    radius = 0.0
    if first.proof.verdict == "holds":
        limits = limits_of(system, domain, assumed.velocity, assumed.noise)
        claims += _reach(system, limits, effort)
        claims += _remainders(system, observer.curvature, effort) if exact else ()
        sizes = disturbance_sizes(bounds)
        if sampling is not None and assumed.disturbance.any():
            claims.append(force_claim(system, assumed.disturbance, effort))
        elif sampling is None and sizes.any():
            square = SLACK * _sampled_disturbance(system, domain, sizes)
            claims.append(DisturbanceClaim(effort.prove("noise", disturbance_bound(system, sizes, square)), square))
        claims += corrections
        if sampling is not None and len(corrections) > sampling.lost:
            claims += missing_claims(observer, system, sampling, matrix, target, claims, effort)
            allowed = _radius(claims, limits, 0.0)
            claims += prediction_claims(observer, sampling, matrix, target, bounds, claims, allowed, effort)
        claims += start_claim(observer.model, system, claims, effort)
        radius = _radius(claims, limits, steady_of(sampling, matrix, target, bounds, claims))
        if exact:
            # The largest, of some, with which half of the rate remains; none below a hundredth of the tube of (5).
            gains = float(observer.alpha), float(observer.beta)
            tried = (radius * np.geomspace(1.0, 0.01, 45)).tolist()
            radius = next((r for r in tried if Remainder.of(gains, matrix, claims, r).rate <= target / 4), 0.0)
    document = Document(
        "the proof",
        recipe,
        observer_document(observer),
        matrix,
        target,
        radius,
        assumed.velocity,
        bounds,
        domain.low,
        domain.high,
        tuple(claims),
        {},
        sampling,
        system.driven,
    )
    facts = Resolved(document, observer, system)
    statement = contraction_statement(facts, "proved")
    elapsed, check_start = time.monotonic() - start, time.monotonic()
    if checker != "off" and statement.verdict == "holds":
        effort.report("by the checker", 0.0, sum(claim.proof.boxes for claim in claims))
        result = judged(facts, max(elapsed, PATIENCE) if checker == "auto" else math.inf)
        statement = contraction_statement(facts, "proved", result)
    if statement.verdict != "holds":
        facts = facts._replace(document=document._replace(radius=0.0))
    return ContractionCertificate.of(facts, statement, verified=True, checker_seconds=time.monotonic() - check_start)


class _Assumed(NamedTuple):
    """Bounds (n,) of the velocity, the errors of the estimate and of a measurement, and an unmodelled force."""

    velocity: Float[np.ndarray, "n"]
    error: Float[np.ndarray, "n"]
    noise: Float[np.ndarray, "n"]
    disturbance: Float[np.ndarray, "n"]


def _check_assumptions(
    observer: Intrinsics, velocity: ArrayLike, error: ArrayLike, noise: ArrayLike, disturbance: ArrayLike
) -> _Assumed:
    n = len(observer.model.coordinates or observer.model.velocities)
    speeds, errors = amount("velocity", velocity, n), amount("error", error, n)
    assumed = _Assumed(speeds, errors, amount("noise", noise, n), amount("disturbance", disturbance, n))
    if not (assumed.noise < errors).all():
        raise InputError(
            f"certify: noise must be below the error {errors.tolist()}, which includes it; got {assumed.noise.tolist()}"
        )
    check_unique(observer, errors)
    return assumed


def _reach(system: ErrorSystem, limits: np.ndarray, effort: Effort) -> Iterator[ReachClaim]:
    """Claims that bound the change of each position error and each velocity along a curve of unit length."""
    sampled = sampled_widths(system, effort.domain)

    def wider(claim: ReachClaim, point: np.ndarray) -> ReachClaim:
        square = float(squared_widths(system, jnp.asarray(point))[claim.row])
        return dataclasses.replace(claim, square=SLACK * max(claim.square, square))

    for row, limit in enumerate(limits.tolist()):
        yield effort.prove_claim(
            f"reach {row + 1} of {len(limits)}",
            ReachClaim(UNPROVED, row, float(SLACK * sampled[row]), limit),
            lambda claim: width_bound(system, claim.row, claim.square),
            wider,
            WIDENINGS,
        )


def _remainders(system: ErrorSystem, curvature: bool, effort: Effort) -> Iterator[RemainderClaim]:
    """Claims on the tensors in which the exact observer differs from its approximation."""
    for row, tensor in enumerate(RemainderClaim.TENSORS):
        # The matrix is square G − TᵀgT, so that its values for 0 and 1 give the largest |T|², relative to G.
        forms = (remainder_bound(system, row, square, curvature) for square in (0.0, 1.0))
        low = jnp.asarray(effort.domain.low)
        none, one = (_sample_function(form.graph(low).entries, effort.domain, 2000) for form in forms)
        largest = float(np.linalg.eigvals(np.linalg.solve(one - none, -none)).real.max())
        yield effort.prove_claim(
            f"bound of {tensor}",
            RemainderClaim(UNPROVED, row, max(REMAINDER_SLACK * largest, LEAST_REMAINDER)),
            lambda claim: remainder_bound(system, claim.row, claim.square, curvature),
            lambda claim, point: dataclasses.replace(claim, square=claim.square * SLACK),
            WIDENINGS,
        )


def _radius(claims: Sequence[AbstractClaim], limits: np.ndarray, steady: float) -> float:
    """Largest radius that all claims allow; zero if one is not proved or estimates may end outside of it."""
    if any(claim.proof.verdict != "holds" for claim in claims):
        return 0.0
    # Rounded down: the statement also holds for a smaller radius.
    radius = float((limits / np.sqrt(reach_squares(claims))).min())
    radius *= 1 - 1e-9
    return radius if steady < radius else 0.0


def _in_continuous_time(
    observer: Intrinsics, matrix: TwoByTwo, target: float, assumed: _Assumed, region: Region, effort: Effort
) -> tuple[ErrorSystem, Box, Given, ContractionClaim]:
    """System, domain, given bounds, and the claim that the flow contracts.

    Dry friction and its slopes are first treated as bounded variables that do not depend on the velocity; if that does
    not suffice, friction is a function of the velocity.
    """
    model = observer.model
    if has_dry_friction(model, assumed.velocity):
        # The error means that friction has no bounds over the region; as a function of the velocity it may still work.
        with contextlib.suppress(InputError):
            system = error_system(observer, matrix, joint_friction=True)
            effort.domain, bounds = _domain(observer, system, assumed, region, joint_friction=True)
            proof = effort.prove("contraction", contraction(system, target))
            # A friction that refutes the claim may differ from the friction of the model.
            if proof.verdict != "fails":
                return system, effort.domain, bounds, ContractionClaim(proof)
    system = error_system(observer, matrix)
    effort.domain, bounds = _domain(observer, system, assumed, region)
    return system, effort.domain, bounds, ContractionClaim(effort.prove("contraction", contraction(system, target)))


def _stated_bounds(region: Region, assumed: _Assumed, slopes: np.ndarray) -> Given:
    """The bounds that a certificate states, including bounds (n, n) of the slopes of the force."""
    ends = np.stack([region.true.low, region.true.high])
    return Given(ends, region.inputs, np.array(region.times, float), assumed.noise, assumed.disturbance, slopes)


def _domain(
    observer: Intrinsics, system: ErrorSystem, assumed: _Assumed, region: Region, joint_friction: bool = False
) -> tuple[Box, Given]:
    """The box of estimate, error, force and perhaps friction, and the data from which force bounds follow."""
    model, true, n = observer.model, region.true, len(assumed.velocity)
    noise, disturbance, inputs, times = assumed.noise, assumed.disturbance, region.inputs, region.times
    measured = true
    if model.manifold.commuting and noise.any():
        measured = true._replace(low=_sum(true.low, -noise, -1), high=_sum(true.high, noise, 1))
    # The true force and the one that the observer uses may differ by the whole disturbance, in either direction.
    force = force_bounds(model, measured, inputs, times)
    if disturbance.any():
        force = np.stack([_sum(force[0], -disturbance, -1), _sum(force[1], disturbance, 1)])
    slopes = force_slopes(model, measured, inputs, times) if noise.any() else np.zeros((n, n))
    bounds = _stated_bounds(region, assumed, slopes)
    estimates = _around(true, assumed.error) if model.manifold.commuting else np.zeros((2, 0))

    signals = np.concatenate([bounds.times[:, None], inputs], axis=1)[:, list(system.driven)]

    def rest(speed):
        return np.concatenate([force, *(friction_bounds(model, speed) if joint_friction else ()), signals], axis=1)

    return _widen_box(system, assumed, estimates, rest), bounds


def _sampled_domain(
    model: MechanicalSystem, assumed: _Assumed, region: Region, sampling: Sampling, system: ErrorSystem
) -> Box:
    """The box of the variables of a sampled system."""

    def rest(speed):
        joints = joint_bounds(model, region.inputs, speed, assumed.disturbance)
        return np.concatenate([joints.force, joints.total, joints.slopes, [[0.0], [sampling.oldest]]], axis=1)

    if model.manifold.commuting:
        estimates = _around(region.true, assumed.error)
    else:  # entries of rotations are at most 1, wherever true motion and estimate are
        ones = np.ones(system.first_velocity(len(assumed.velocity)))
        estimates = np.stack([-ones, ones])
    return _widen_box(system, assumed, estimates, rest)


def _around(true: Box, error: np.ndarray) -> np.ndarray:
    """Bounds (2, n) of estimates within the error of the true positions, in coordinates."""
    # Rounded outward, since the region must contain every estimate within the error.
    return np.stack([_sum(true.low, -error, -1), _sum(true.high, error, 1)])


def _widen_box(
    system: ErrorSystem, assumed: _Assumed, estimates: np.ndarray, rest: Callable[[np.ndarray], np.ndarray]
) -> Box:
    """The box of estimates, their velocities, errors and forces.

    `estimates` are bounds (2, p) of the variables of the configuration. `rest` returns, for a bound of the velocities,
    the bounds (2, k) of the variables that come after the error.
    """
    velocity, error, noise, _ = assumed
    low, high = estimates

    def box(excess):
        speed = _sum(velocity, excess, 1)
        force = rest(speed)
        return Box(
            system.names,
            system.units,
            np.concatenate([low, -speed, -error, force[0]]),
            np.concatenate([high, speed, error, force[1]]),
        )

    # The velocity error is chosen in proportion to the position error, so that both limit the tube equally.
    excess = np.zeros(len(velocity))
    # Widths and box depend on each other: a few fixed-point iterations, with a margin of a tenth.
    for _ in range(3):
        roots = np.sqrt(sampled_widths(system, box(excess)))
        # The radius is the least (error − noise)/width of a position; times the width of a velocity it is its excess.
        excess = 1.1 * roots[len(velocity) :] * ((error - noise) / roots[: len(velocity)]).min()
    return check_box(box(excess))


def limits_of(system: ErrorSystem, domain: Box, velocity, noise) -> Float[np.ndarray, "two_n"]:
    """Compute by how much errors and velocities may change within the region.

    Position errors are measured from the measured position, so the noise is subtracted.
    """
    n = len(velocity)
    start = system.first_velocity(n)
    speed, error = slice(start, start + n), slice(start + n, start + 2 * n)
    most = np.minimum(domain.high, -domain.low)
    # Rounded down, since a limit may not exceed the exact difference.
    return np.concatenate([_sum(most[error], -noise, -1), _sum(most[speed], -velocity, -1)])


def _sum(a: np.ndarray, b: np.ndarray, side: int) -> np.ndarray:
    """a + b, rounded up (`side` 1) or down (−1); the rounding error is known exactly (D. E. Knuth, TAOCP 2, 4.2.2)."""
    total = a + b
    part = total - a
    lost = (a - (total - part)) + (b - part)
    return np.where(side * lost > 0, np.nextafter(total, side * np.inf), total)


def sampled_widths(about: ErrorSystem, domain: Box, count: int = 2000) -> Float[np.ndarray, "two_n"]:
    """Compute the largest `squared_widths` at random points and corners of the region."""
    return _sample_function(lambda z: squared_widths(about, z), domain, count).max(axis=0)


def _sampled_disturbance(about: ErrorSystem, domain: Box, sizes: np.ndarray, count: int = 2000) -> float:
    """The largest squared change of the flow by errors in the unit ball, at random points and corners."""
    entries = disturbance_bound(about, sizes, 0.0).graph(jnp.asarray(domain.low)).entries
    matrices = _sample_function(entries, domain, count)
    # With square = 0 the matrix is −BᵀMB; its least eigenvalue is the largest squared length, with opposite sign.
    return float(-np.linalg.eigvalsh(matrices).min())


def _sample_function(function: Callable | Lowered, domain: Box, count: int) -> np.ndarray:
    """Values of a function at random points of a box; every second point is a corner."""
    share = np.random.default_rng(0).uniform(size=(count, len(domain.low)))
    # Extremes of such functions are often at corners, which uniformly drawn points do not reach.
    share[::2] = np.round(share[::2])
    points = domain.low + share * (domain.high - domain.low)
    return numbers(function if isinstance(function, Lowered) else lower(function, points[0]), points)
