"""Certifies that `MeasuredCoefficients` converges from all first errors, and chooses its gains.

The small-gain condition is `‖diag(1/ω) W⁻¹ N W‖₂ ≤ R`, N the coupling of the joints by their velocities, with channels
whose gain is below 1/R; see `_document`. With N the largest sampled coupling, ω_i ∝ (N w)_i/w_i satisfies it for every
w > 0, and the variance of the velocities by encoder noise is ∝ Σ σ_i² ω_i³, which is convex in log w.

Source: an addition; Boyd, Kim, Vandenberghe & Hassibi 2007, A tutorial on geometric programming, for the gains.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from covariant._domains import NOT_NEGATIVE, SPAN, Count, NotNegative, Positive, Whole, check_numbers
from covariant.certificates.base import (
    PERIODIC,
    SPEED,
    Bounds,
    Hypothesis,
    Statement,
    amount,
    check_recipe,
    dimension,
    need_doubles,
)
from covariant.certificates.everywhere._chain import Chain, solve_for
from covariant.certificates.everywhere._channel import DAMPING, gain_matrix, least_gain_of
from covariant.certificates.everywhere._coupling import (
    MARGIN,
    Coupling,
    CouplingBound,
    bound_coupling,
    compare_connections,
)
from covariant.certificates.everywhere._document import GlobalDocument, need_covered, statement_of
from covariant.certificates.everywhere._handover import Handover
from covariant.certificates.proving import friction_bounds, friction_on
from covariant.models import MechanicalSystem
from covariant.observers import AbstractObserver, MeasuredCoefficients
from scalargraph.errors import InputError
from scalargraph.proofs import MOST_BOXES, Box, Proof, check_box, prove, to_letters

ROOM = 0.99
"""Square of the gain that is asked for, as a fraction of the square that is proved."""
RATE = 0.1
"""Rate μ of gains that are chosen here, as a fraction of the least ω."""
DENSE = 1.0
"""Largest ω times the longest time between samples."""
FEW = 2000
"""Boxes that are tried before the inertia is bounded joint by joint."""
CELLS, PLACES = 4096, 50
"""Parts of the velocities on which friction is bounded, and random configurations where the connection is compared."""


class GlobalCertificate(NamedTuple):
    """A statement about all first errors, with the observer and the numbers that it is about.

    Attributes:
        statement: the claim with its hypotheses.
        observer: the observer, with its gains and the bound of its speeds.
        document: all numbers of the claim, as they are saved.
        proof: the tree of boxes of the coupling.

    Example:
        >>> from covariant import models
        >>> from covariant.certificates import certify_globally
        >>> arm = models.pendulum_chain((1.0, 1.0), (0.5, 0.5))
        >>> certify_globally(arm, velocity=1.0, interval=(0.001, 0.001)).observer.speed.tolist()
        [1.0, 1.0]
    """

    statement: Statement
    observer: MeasuredCoefficients
    document: GlobalDocument
    proof: Proof

    def hand_over(self, sharp: AbstractObserver, *, velocity: ArrayLike, position: ArrayLike = np.inf) -> Handover:
        """Build the observer that hands over to a sharper one, once the errors are proved to be small.

        Use it where the proof needs larger gains than the noise allows, or where a filter is more accurate near the
        truth. Each step also returns bounds of the error of what is reported, `position_bound` and `velocity_bound`:
        that of the proved observer, and as long as the sharper one is reported its distance from it besides. They rest
        on the assumptions of the certificate and on nothing that the sharper observer does. The proved observer takes
        over again if the two are farther apart than its bound and the errors given here allow, or if a measurement
        contradicts the certificate: of an arm that is faster than stated, after a jump, or after too long a gap.

        Args:
            sharp: an observer of the same model, such as `Intrinsic`, or a filter behind its gate.
            velocity: errors of the velocities [unit/s], one or (n,), below which it takes over.
            position: errors of the positions [unit], one or (n,); any by default.

        Returns:
            The observer of both.

        Raises:
            ValueError: nothing is proved, the errors that remain are not proved to be as small as that, or the sharper
                observer is one of other coordinates or with further sensors.

        Example:
            >>> from covariant import models, observers
            >>> from covariant.certificates import certify_globally
            >>> arm = models.pendulum_chain((1.0, 1.0), (0.5, 0.5))
            >>> certificate = certify_globally(arm, velocity=1.0, interval=(0.001, 0.001), jerk=1.0)
            >>> both = certificate.hand_over(observers.Intrinsic(arm, 40.0, 800.0), velocity=0.1)
            >>> both.init(arm.manifold.origin()).holds.item()
            0.0
        """
        document = self.document
        if not self.statement.proved:
            raise InputError("hand_over: nothing is proved")
        reach, radius = document.reach, document.radius()
        level = min(np.min(np.asarray(each) / unit) for each, unit in zip((position, velocity), reach, strict=True))
        if not radius < level:
            left = ", ".join(f"{each:.3g}" for each in reach[1] * radius)
            raise InputError(f"hand_over: velocities are proved to be within {left} in the end; give larger errors")
        scale = np.stack([document.omega, np.ones_like(document.omega)]) / document.weights
        form = np.einsum("ai,iab,bi,ij->aibj", scale, document.metrics, scale, np.eye(len(scale.T)))
        limits = np.concatenate([document.noise, document.velocity])
        numbers = form.reshape(limits.size, -1), np.concatenate(reach), limits, document.ages, document.rate
        return Handover(self.observer, sharp, *map(jnp.asarray, (*numbers, radius, level)))

    def velocity_noise(self, std: ArrayLike) -> Float[np.ndarray, "n"]:
        """Standard deviations (n,) of the velocities by independent encoder noise, of linear channels.

        Args:
            std: standard deviation of the encoders [unit], one or (n,).

        Returns:
            `√(h ω³/2c) σ` with c = α/ω and the longest interval h between samples.
        """
        omega, alpha = self.document.omega, self.document.alpha
        return np.asarray(std) * np.sqrt(self.document.interval[1] * omega**4 / (2 * alpha))


@check_numbers
def certify_globally(
    observer: MeasuredCoefficients | MechanicalSystem,
    *,
    interval: Annotated[Sequence[float], SPAN],
    velocity: Annotated[ArrayLike, SPEED] | None = None,
    position: Bounds | None = None,
    noise: Annotated[ArrayLike, NOT_NEGATIVE] = 0.0,
    disturbance: Annotated[ArrayLike, NOT_NEGATIVE] = 0.0,
    jerk: Annotated[ArrayLike, NOT_NEGATIVE] = 0.0,
    lost: Whole = 0,
    rate: Positive | None = None,
    omega: NotNegative = 0.0,
    recipe: dict[str, Any] | None = None,
    boxes: Count = 50 * MOST_BOXES,
    seconds: Positive | None = None,
    progress: Callable[[str, float, int], None] | None = None,
) -> GlobalCertificate:
    """Prove that `MeasuredCoefficients` converges from all first errors of position and velocity, at samples.

    Use it for an arm whose speeds are bounded. It bounds by interval arithmetic how strongly the joints couple, over
    all configurations within their limits, and compares that with the gain of the observer's channels from sample to
    sample. Given a model, it chooses the smallest gains that it can prove, one ω for each joint.

    Args:
        observer: the observer, or a model in coordinates, for which gains are chosen.
        interval: shortest and longest time between samples [s].
        velocity: bound V of each true velocity [unit/s], a number or (n,); by default that of the observer.
        position: least and largest configurations, (n,) each; by default, and where they are NaN, the limits of the
            joints in a robot's file, and a whole turn of circles.
        noise: bound of the error of each measured position [unit], a number or (n,).
        disturbance: bound of the force in each coordinate that the model does not know, a number or (n,).
        jerk: bound of the change of each acceleration within a sample, per second [unit/s³]. The statement also says
            what each unit of it adds.
        lost: how many samples in a row may be lost.
        rate: rate μ [1/s] of the errors; by default a tenth of the least ω for gains that are chosen, else the largest
            that is found.
        omega: smallest ω [1/s] of gains that are chosen; larger ones follow unknown accelerations faster.
        recipe: recipe of the model, for the statement and its file.
        boxes: largest number of boxes.
        seconds: limit of time [s] for the boxes; the bound so far is then used.
        progress: called with the proof, the share that is done, and the number of boxes.

    Returns:
        The certificate. Its statement is undecided if the coupling has no bound within the effort, or if the gains
        suffice for none.

    Raises:
        ValueError: the observer is another one or of a subclass; or the model is on a group, has friction that couples
            joints, jumps or depends on the position, or a coordinate without limits.

    Example:
        >>> from covariant import models
        >>> from covariant.certificates import certify_globally
        >>> arm = models.pendulum_chain((1.0, 1.0), (0.5, 0.5))
        >>> certificate = certify_globally(arm, velocity=1.0, interval=(0.001, 0.001))
        >>> certificate.statement.short, bool(certificate.document.omega.max() < 20)
        ('holds (proved)', True)
    """
    need_doubles("certify_globally")
    given: Any = observer if type(observer) is MeasuredCoefficients else None
    model: Any = observer if given is None else given.model
    need_covered(model)
    check_recipe(model, recipe)
    n = dimension(model)
    clip: Any = None if given is None else np.broadcast_to(np.asarray(given.speed), (n,))
    if velocity is None and (clip is None or not np.isfinite(clip).all()):
        raise InputError("certify_globally: velocity is missing, the bound of the true speeds that the clip is for")
    speed = amount("velocity", clip if velocity is None else velocity, n)
    if clip is not None and not np.array_equal(clip, speed):
        raise InputError("certify_globally: velocity differs from the speed to which the observer clips")
    viscous, dry = _friction(model, speed)
    given_bounds = ("noise", noise), ("disturbance", disturbance), ("jerk", jerk)
    errors = [amount(key, value, n) for key, value in given_bounds]
    domain, ones = _domain(model, position, errors[0]), np.ones(n)
    gains = (ones, ones) if given is None else (given.alpha, given.beta)
    alpha, beta = (np.broadcast_to(np.asarray(gain, float), (n,)) for gain in gains)
    about = recipe, domain.low, domain.high, speed, alpha, beta, ones, viscous, dry, *errors, 0 * ones
    found_later = rate or 0.0, math.inf, np.tile(np.eye(2), (n, 1, 1)), (), np.zeros((0, 49))
    document = GlobalDocument._make((*about, np.asarray(interval, float), lost, *found_later))
    coupling = Coupling.of(model, domain, document)
    # What is sampled here, at ω = W = 1, is the coupling itself.
    largest = coupling.sampled()[0].max(0)
    if given is None and not largest.any():
        raise InputError("certify_globally: no coordinate couples by its speed, so that any gains do; give an observer")
    # Coordinates that do not couple get a small gain too.
    largest = largest + 0.02 * max(float(largest.max()), 1e-3)
    if given is None:
        shape = _shape(largest, np.where(errors[0] > 0, errors[0], 1.0))
        document = document._replace(alpha=DAMPING * shape, beta=shape**2)
    document = document._replace(weights=_perron(largest / document.omega[:, None]))
    # Of given gains it is known which coupling they allow.
    enough = 0.0 if given is None else _allowed(document._replace(rate=rate or 0.02 * float(document.omega.min())))
    told = None if progress is None else lambda share, count: progress("the coupling", share, count)
    effort = given is None, enough, boxes, seconds, told
    bounded = _bounds(coupling._replace(document=document), Chain.of(model.space), *effort)
    least, best = omega if given is None else None, None
    for document, bound in bounded:
        tries = _tries(document, least, rate) if bound.norm < math.inf else ()
        found = next((found for each in tries if (found := _metrics(each)) is not None), None)
        # What is bounded says which gains would do, even if no such gains exist at these samples.
        if found is not None or best is None or best[1].norm == math.inf:
            best = found or document, bound
        if found is not None:
            break
    assert best is not None
    document, bound = best
    hypotheses = (*_hypotheses(document, bound, model), compare_connections(model.space, domain, PLACES))
    statement = statement_of(document, model, hypotheses, all(each.verdict == "holds" for each in hypotheses))
    made = MeasuredCoefficients(model, document.alpha, document.beta, speed) if given is None else given
    return GlobalCertificate(statement, made, document, bound.proof)


def _bounds(
    coupling: Coupling,
    chain: Chain | None,
    designed: bool,
    enough: float,
    boxes: int,
    seconds: float | None,
    told: Callable[[float, int], None] | None,
) -> Iterator[tuple[GlobalDocument, CouplingBound]]:
    """Bounds of the coupling, with their documents, in the order in which they are tried.

    Boxes are sharp and few for three joints, and too many for six; joint by joint the bound is coarse, and cheap.
    """
    few = boxes if chain is None else min(boxes, FEW)
    bound, document = bound_coupling(coupling, enough, few, seconds, told), coupling.document
    if chain is None or bound.norm <= max((1 + MARGIN) * bound.sampled, enough):
        levels = tuple(to_letters(bound.proof.levels))
        yield document._replace(acceleration=bound.acceleration, coupling=bound.norm, levels=levels), bound
        return
    inertia = solve_for(chain, coupling)
    proof = None if inertia is None else chain.prove(inertia, coupling.domain)
    if inertia is not None and proof is not None and proof.verdict == "holds":
        document = chain.gains(inertia, document, designed)
        norm, acceleration = chain.bounds(inertia, document)
        document = document._replace(acceleration=acceleration, coupling=norm, inertia=inertia.rows())
        yield document, CouplingBound(norm, bound.sampled, acceleration, proof)
    yield from _bounds(coupling, None, designed, enough, boxes, seconds, told)


def _domain(model: MechanicalSystem, position: Bounds | None, noise: np.ndarray) -> Box:
    """The box of measured configurations: as given, or the limits of the joints, and the noise around it."""
    n = len(noise)
    limits = {name: ends for name, *ends in getattr(model.space, "limits", ())}
    ends = np.array([limits.get(name, (-math.inf, math.inf)) for name in model.coordinates], float)
    ends[list(model.circles)] = -math.pi, math.pi
    given = np.stack([np.broadcast_to(np.asarray(side, float), (n,)) for side in position or (math.nan, math.nan)])
    low, high = np.where(np.isnan(given), ends.T, given)
    if not np.isfinite([low, high]).all():
        name = model.coordinates[int(np.flatnonzero(~np.isfinite([low, high]).all(0))[0])]
        raise InputError(f"certify_globally: {name} has no limits; give the ends of all configurations as position")
    return check_box(Box(model.coordinates, model.units or ("",) * n, low - noise, high + noise))


def _friction(model: MechanicalSystem, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F (n,), and bounds (n,) of how much more than F times their distance friction differs between two velocities."""
    # Any F is sound; the least slope leaves dry friction, which is steep near rest, to the rest. The margins leave room
    # for a checker that bounds slopes in another way.
    viscous = np.maximum(friction_bounds(model, speed)[1][0], 0.0) * (1 + 1e-11)
    ends = np.linspace(-1, 1, CELLS + 1)[:, None] ** 3 * speed  # small where dry friction is steep, near rest
    slopes = np.abs(friction_on(model, speed, ends[:-1], ends[1:])[1]).max(0)
    dry = 1.02 * (np.maximum(slopes - viscous, 0.0) * np.diff(ends, axis=0)).sum(0)
    if not np.isfinite(dry).all():
        raise InputError("the slope of the model's friction has no bound over the velocities; make them smaller")
    return viscous, dry


def _perron(matrix: np.ndarray) -> np.ndarray:
    """W (n,) with which `W⁻¹AW` has the spectral radius of A > 0 as its norm: √(r/l) of A's two eigenvectors."""
    pairs = map(np.linalg.eig, (matrix, matrix.T))
    right, left = (np.abs(vectors[:, np.real(values).argmax()]) for values, vectors in pairs)
    return np.sqrt(right / left)


def _shape(sampled: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """ω (n,) up to a factor, for the least noise of the velocities."""
    from scipy.optimize import minimize

    def variance(logs):
        return math.log(float((noise**2 * (sampled @ np.exp(logs) * np.exp(-logs)) ** 3).sum()))

    w = np.exp(minimize(variance, np.zeros(len(sampled)), method="BFGS").x)
    return sampled @ w / w


def _gains(document: GlobalDocument) -> list[tuple[float, np.ndarray]]:
    """For each channel the least square of its gain at the document's rate, with its metric."""
    ages = np.unique(document.ages)
    pairs = zip(document.alpha.tolist(), document.beta.tolist(), strict=True)
    # At a slightly larger rate the matrix of the proof is definite with some room.
    return [least_gain_of(alpha, beta, 1.02 * document.rate, ages) for alpha, beta in pairs]


def _allowed(document: GlobalDocument) -> float:
    """The coupling that the gains of a document allow at its rate."""
    return math.sqrt(0.98 * ROOM / max(square for square, _ in _gains(document)))


def _metrics(document: GlobalDocument) -> GlobalDocument | None:
    """The document with metrics that prove its gain at its rate; None where none are found."""
    found = _gains(document)
    fits = all(square <= ROOM * document.square for square, _ in found)
    return document._replace(metrics=np.stack([p for _, p in found])) if fits else None


def _tries(document: GlobalDocument, least: float | None, rate: float | None) -> Iterator[GlobalDocument]:
    """Multiples of ω from the smallest that may do, each at least as large as is asked; for given gains, rates."""
    if least is None:
        fastest = 0.5 * float(document.alpha.min())
        for mu in [rate] if rate else np.geomspace(fastest, 2e-4 * fastest, 20).tolist():
            yield document._replace(rate=mu)
        return
    shape, norm = document.omega, document.coupling
    factor = 1.38 * norm
    while factor * shape.max() * document.ages[-1, 1] <= DENSE:
        omega = np.maximum(factor * shape, min(least, DENSE / document.ages[-1, 1]))
        gains = {"alpha": DAMPING * omega, "beta": omega**2, "rate": rate or RATE * float(omega.min())}
        yield document._replace(coupling=norm / factor * (1 + 1e-12), **gains)
        factor *= 1.03


def _hypotheses(document: GlobalDocument, bound: CouplingBound, model: MechanicalSystem) -> tuple[Hypothesis, ...]:
    def judge(text, holds, remedy=""):
        return Hypothesis(text, "proved", "holds" if holds else "undecided", place="" if holds else remedy)

    bounded = bound.proof.verdict == "holds"
    limit = f"below {document.coupling:.6g}" if bounded else "bounded"
    needed = np.array2string(1.45 * (bound.norm if bounded else bound.sampled) * document.omega, precision=3)
    claims = [
        (gain_matrix(alpha, beta, p, document.rate, document.square), Box(("age",), ("s",), age[:1], age[1:]))
        for alpha, beta, p in zip(document.alpha.tolist(), document.beta.tolist(), document.metrics, strict=True)
        for age in document.ages
    ]
    turn = 2 * (document.velocity * document.ages[-1, 1] + document.noise)[list(model.circles)]
    return (
        judge(
            f"the coupling of the coordinates is {limit}, and unknown accelerations are below their bounds"
            f"{', by bounds of the inertia joint by joint' if len(document.inertia) else ''} "
            f"({bound.proof.boxes} boxes)",
            bounded,
            f"{bound.proof.open_share:.1%} of the configurations, where boxes are too large for a bound; more boxes or "
            f"time, or a smaller region, may do; by sampling, ω = {needed} 1/s would suffice",
        ),
        judge(
            "the gain of each channel is below the inverse of that at the rate stated, at all times between samples",
            bounded and document.rate > 0 and all(prove(*claim).verdict == "holds" for claim in claims),
            f"these gains; ω = {needed} 1/s or more is needed, at samples closer than 1/ω" if bounded else "",
        ),
        judge("circles turn by less than half a turn between samples", (turn < math.pi * (1 - 1e-9)).all()),
        *([Hypothesis(PERIODIC, "proved")] if model.circles else []),
    )
