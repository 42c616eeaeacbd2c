"""Certifies by distances that the estimate of `LagrangianMetric` approaches the truth from large errors, at any gain.

`certificates.distance_decay` has the argument and the numbers for samples, and `certificates.lifted_gain` for dense
measurements. What they need of the model is proved here on a box of
positions, from the graphs of metric and force and their derivatives:

- bounds of the sectional curvature of the plane of both coordinates, and of the covariant Hessian −∇S;
- the lengths of the coordinates' differentials, by which the length of a curve limits where it can lead;
- a constant metric g_* ≤ g, and the largest determinant of g, which give a distance `π/√(κμ)` up to which positions
  have a single shortest geodesic, μ = √(det g/det g_*): a shortest loop of length 2i encloses an area of at most
  μ(2i)²/4π (isoperimetry in g_*), with a total curvature of at least π (Gauss and Bonnet), so that κμi²/π ≥ π
  (Klingenberg).

Source: an addition; do Carmo 1992, Riemannian Geometry, chapter 13, for Klingenberg's lemma.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from covariant._domains import NOT_NEGATIVE, Count, NotNegative, Positive, check_numbers
from covariant.certificates.base import (
    ANALYTIC,
    PERIODIC,
    SPEED,
    Bounds,
    Hypothesis,
    Statement,
    amount,
    check_recipe,
    dimension,
    lowered_christoffel,
    metric_form,
    need_doubles,
    need_known,
    region_of,
)
from covariant.certificates.theory._implicit_distances import DistanceBounds, DistanceDecay, distance_decay
from covariant.certificates.theory._lifted_metric import dense_decay, least_gain
from covariant.geometry import AbstractSpace
from covariant.models import MechanicalSystem, applied_force, recipe_text, resistance
from covariant.observers import LagrangianMetric
from scalargraph import LoweringError, lower, numbers
from scalargraph.errors import InputError
from scalargraph.proofs import MOST_BOXES, Box, Form, Proof, check_box, derivative_form, prove

MARGIN = 0.01
"""Margin that is added to a sampled bound before it is proved, as a fraction of it."""
POINTS = 33
"""Points per coordinate at which bounds are guessed."""
PLACES = 200
"""Random positions at which the connection of the space is compared with that of its metric."""
AGREES = 1e-8
"""Largest relative deviation between two computations of a connection that counts as rounding."""
ASSUMED_OF_DISTANCES = (
    "the true motion solves the model, with the input that the observer is given, and keeps to the bounds of "
    "velocities and inputs, and away from the border of the region as stated",
    "measurements are exact, of all coordinates, unwrapped, and come as often as stated",
    "predictions, geodesics and transport are computed exactly, and the geodesic to the measurement is the shortest",
    "the code of the model is read as exact functions of real numbers, with its constants as they were computed",
    "trusted are JAX's tracing, the reading of its jaxprs, IEEE doubles, the formulas of "
    "`certificates.distance_decay` and `lifted_gain` in doubles, and what is argued on paper there",
)
"""Assumptions of such a statement."""


class DistanceCertificate(NamedTuple):
    """A statement that distances between estimates and the truth decrease, with the data that it follows from.

    Attributes:
        statement: the claim with its hypotheses.
        decay: rate, radius and metric; see `certificates.DistanceDecay`.
        bounds: the bounds of model, motion and error from which they follow.
        distance_to_border: least distance [unit] of each true coordinate to the border of the region (n,).
        proofs: the proofs of the bounds, by the name of the bound.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import Hypothesis, Statement
        >>> from covariant.certificates.theory import DistanceCertificate
        >>> from covariant.certificates.theory import DistanceBounds, DistanceDecay
        >>> statement = Statement("distances fall", (), (Hypothesis("curvature is bounded", "proved"),), 1.0)
        >>> bounds = DistanceBounds(1.0, 0.1, 1.0, (-1.0, 1.0))
        >>> decay = DistanceDecay(1.0, 2.0, 0.1, 3.0, 500.0, 400.0, 0.0)
        >>> DistanceCertificate(statement, decay, bounds, np.zeros(2), {}).statement.proved  # from `certify_distance`
        True
    """

    statement: Statement
    decay: DistanceDecay
    bounds: DistanceBounds
    distance_to_border: Float[np.ndarray, "n"]
    proofs: dict[str, Proof]


@check_numbers
def certify_distance(
    observer: LagrangianMetric,
    *,
    position: Bounds,
    velocity: Annotated[ArrayLike, SPEED],
    error: Annotated[ArrayLike, NOT_NEGATIVE],
    interval: Positive | None = None,
    velocity_error: NotNegative | None = None,
    input: Bounds | ArrayLike = 0.0,
    recipe: dict[str, Any] | None = None,
    boxes: Count = MOST_BOXES,
) -> DistanceCertificate:
    """Prove that the distance of the estimate from the truth falls from large errors, with samples or without.

    Args:
        observer: the observer, with a model of two coordinates without friction, and its gains.
        position: least and largest positions, (2,) each, of truth and estimates; on circles a whole turn is
            everywhere.
        velocity: bound of each true velocity [unit/s], a number or (2,).
        error: bound of the error of each estimated position [unit] before the first correction, a number or (2,).
        interval: time [s] between two measurements; without it the observer runs in continuous time.
        velocity_error: bound of `|Πv̂ − v|` at that time, a length in the metric, with v̂ transported to the true
            position; by
            default the largest true speed, as for an observer that starts at rest.
        input: bound of each input, a number or (m,), or a pair of bounds. It may depend on time in any way.
        recipe: recipe of the observer's model, for the statement.
        boxes: largest number of boxes for each of the proofs.

    Returns:
        The certificate. Its statement is undecided if the gains do not suffice for these bounds, or a proof did not
        finish.

    Raises:
        TypeError: the observer is not a `LagrangianMetric`, or is of a subclass.
        ValueError: the model is on a group, has friction or a force that depends on time, or does not have two
            coordinates; bounds are not finite and in order, or allow no error at all; or the recipe is of another
            model.

    Example:
        A ball on a beam, expected up to 0.25 m and 0.25 rad from where it is, by an observer that starts at rest:

        >>> from covariant import models, observers
        >>> from covariant.certificates import certify_distance
        >>> observer = observers.LagrangianMetric(models.ball_and_beam(), alpha=1900.0, beta=38000.0)
        >>> certificate = certify_distance(
        ...     observer, interval=0.01, position=([-2.5, -4.0], [2.5, 4.0]), velocity=0.25, error=0.25
        ... )
        >>> certificate.statement.short, certificate.decay.rate > 10
        ('holds (proved)', True)
    """
    if type(observer) is not LagrangianMetric:
        raise TypeError(f"certify_distance is about LagrangianMetric itself; got {type(observer).__name__}")
    model = observer.model
    need_known(model)
    if not model.manifold.commuting or dimension(model) != 2:
        raise InputError(
            "certify_distance needs a model of two coordinates; one alone has part_limits, at any distance"
        )
    need_doubles("certify_distance")
    _need_no_friction(model)
    check_recipe(model, recipe)
    region = region_of(model, position, input, None)
    speeds, errors = amount("velocity", velocity, 2), amount("error", error, 2)
    if velocity_error == 0 and not errors.any():
        raise InputError(
            "certify_distance: error and velocity_error are both 0, so that no error is there to fall; give one of them"
        )
    known = _Model.of(model, region.true._replace(units=model.units or ("", "")), region.inputs)
    found = _prove_bounds(known, speeds, errors, boxes)
    bounds = found.bounds if velocity_error is None else found.bounds._replace(velocity_error=float(velocity_error))
    alpha, beta = float(observer.alpha), float(observer.beta)
    sigma = beta / alpha
    if interval:
        decay = distance_decay(interval, alpha * interval / (1 + alpha * interval), sigma, bounds)
        remedy = "another α or β, or a shorter interval, may do; else smaller bounds"
    else:
        decay, least = dense_decay(alpha, sigma, bounds), least_gain(sigma, sigma / 2, bounds).alpha
        remedy = f"α = {least:.4g}, β = {sigma * least:.4g} does" if least < math.inf else "smaller errors may do"
    # A curve changes a coordinate by no more than its length times that of the coordinate's differential.
    border = (0.0 if math.isnan(decay.reach) else decay.reach) * np.sqrt(found.widest) * (1 + 1e-12)
    circles = np.array([i in model.manifold.circles for i in range(2)])
    border = np.where(circles & (region.true.high - region.true.low >= 2 * math.pi), 0.0, border)
    fits = bool((2 * border < region.true.high - region.true.low).all())
    gains = Hypothesis(
        "the part of an error that a sample takes away, and σ = β/α, suffice for these bounds at the interval"
        if interval
        else "α and σ = β/α suffice for these bounds",
        "proved",
        "holds" if decay.rate > 0 else "undecided",
        decay.rate if decay.rate > 0 else None,
        "" if decay.rate > 0 else remedy,
    )
    room = Hypothesis("the region has positions so far from its border", "proved", "holds" if fits else "undecided")
    hypotheses = (
        *found.hypotheses,
        compare_connections(model.space, known.domain),
        gains,
        *([Hypothesis(PERIODIC, "proved")] if model.manifold.circles else []),
        *([room] if border.any() else []),
    )
    names = ", ".join(
        f"{name} {width:.4g} {unit}".rstrip()
        for name, unit, width in zip(known.domain.names, known.domain.units, border, strict=True)
        if width > 0
    )
    metric = (  # numbers only if there is a rate
        f"metric: m|ξ|² + |w|², w = ζ − σξ, m = {decay.before:.6g}"
        + (f" after a sample and {decay.after:.6g} before the next" if interval else ""),
        f"radius {decay.radius:.6g} in it; positions within {decay.reach:.6g} of the true ones, speeds up to "
        f"{decay.fastest:.6g}, λ = {decay.turning:.4g} < {'π' if interval else 'π/2'}",
    )
    about = (
        f"model: {'one that was given as an object' if recipe is None else recipe_text(recipe)}",
        f"observer: lagrangian-metric, alpha = {alpha!r} 1/s, beta = {beta!r} 1/s², "
        + (f"a sample every {interval!r} s" if interval else "in continuous time"),
        f"positions: {known.domain}" + (f"; the true ones stay from its border by {names}" if names else ""),
        f"true velocities up to {speeds.tolist()}, |v| ≤ {bounds.speed:.6g} in the metric",
        f"inputs from {region.inputs[0].tolist()} to {region.inputs[1].tolist()}",
        f"first errors of the position up to {errors.tolist()}, {bounds.error:.6g} in the metric; of the velocity "
        f"{bounds.velocity_error:.6g} in the metric",
        *(metric if decay.rate > 0 else ()),
        f"proved bounds: curvature {_pair(bounds.curvature)}, −∇S {_pair(bounds.stiffness)} 1/s², one shortest "
        f"geodesic, and errors of circles below half a turn, up to {bounds.injectivity:.4g}",
    )
    claim = f"the distance of an estimate from the truth falls{' from sample to sample' if interval else ''}, whatever "
    claim += "the motion between these bounds"
    if decay.rate > 0:
        claim += f", at the rate {math.floor(1e4 * decay.rate) / 1e4} 1/s or faster, from any error within the radius"
    assumed = (Hypothesis(text, "assumed") for text in ASSUMED_OF_DISTANCES)
    statement = Statement(claim, about, (*hypotheses, *assumed), decay.rate, str(known.domain))
    return DistanceCertificate(statement, decay, bounds, border, found.proofs)


def _pair(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.6g} to {ends[1]:.6g}"


def _need_no_friction(model: MechanicalSystem) -> None:
    q = jnp.zeros(2)
    lowered = lower(
        lambda t, q, v, u: resistance(model, t, q, v, u), jnp.zeros(()), q, q, jnp.zeros(model.inputs or 2), real=True
    )
    if not all(lowered.graph.is_zero(i) for i in lowered.outputs):
        raise InputError("certify_distance: the model has friction, which is not covered; leave it out of the model")


class _Model(NamedTuple):
    """A model on a box of positions (`domain`) and inputs (`whole`), as `derivative_form` needs it."""

    model: MechanicalSystem
    domain: Box
    whole: Box

    @classmethod
    def of(cls, model: MechanicalSystem, domain: Box, inputs: Float[np.ndarray, "2 m"]) -> "_Model":
        names = tuple(f"u{i + 1}" for i in range(inputs.shape[1]))
        ends = (np.concatenate([side, other]) for side, other in zip((domain.low, domain.high), inputs, strict=True))
        return cls(model, domain, check_box(Box((*domain.names, *names), (*domain.units, *[""] * len(names)), *ends)))

    def points(self) -> Array:
        """A grid of positions with the corners of the inputs, at which bounds are guessed."""
        axes = [np.linspace(*ends, POINTS) for ends in zip(self.domain.low, self.domain.high, strict=True)]
        inputs = zip(self.whole.low[2:], self.whole.high[2:], strict=True)
        return jnp.asarray(list(itertools.product(*axes, *map(np.unique, inputs))))

    def form(self, formula: Callable[..., Array]) -> Form:
        """The form of an expression in g, ∂g, ∂²g, the force f and ∂f, as functions of position and input."""

        def values(t, q, z):
            return self.model.space(q), applied_force(self.model, t, q, z[2:])

        def parts(derivatives, nodes, k):
            g, f = nodes
            first = derivatives.each(g, range(1, 1 + k))
            return g, first, derivatives.each(first, range(1, 1 + k)), f, derivatives.each(f, range(1, 1 + k))

        return derivative_form(values, lambda z: z[:2], parts, formula)


def compare_connections(space: AbstractSpace, domain: Box, places: int = PLACES) -> Hypothesis:
    """Compare the connection of the space, used by the observer, with that of the metric, used in the bounds."""
    # The space declares its connection or derives it from the metric by JAX; the bounds use the graph of the metric.
    n = len(domain.low)
    identity = jnp.eye(n)

    def declared(q):
        """Compute `g Γ(e_i, e_j)` and `g g⁻¹` with the operations of the space."""
        pairs = jnp.stack([jnp.stack([space.connection(q, a, b) for b in identity]) for a in identity])
        raised = jnp.stack([space.raise_(q, a) for a in identity])
        return jnp.concatenate([(pairs @ space(q)).ravel(), (raised @ space(q)).ravel()])

    def derived(_, slopes):
        return jnp.concatenate([lowered_christoffel(slopes).ravel(), identity.ravel()])

    points = np.random.default_rng(0).uniform(domain.low, domain.high, (places, n))
    expected = metric_form(space, derived).at(points)
    try:
        lowered = lower(declared, jnp.zeros(n))
        computed = np.asarray(numbers(lowered, points))
        analytic = {node.op for node in lowered.graph.nodes} <= ANALYTIC
    except LoweringError:
        computed, analytic = np.asarray(jax.lax.map(declared, jnp.asarray(points))), False
    off = np.abs(computed - expected).max(axis=1) / np.maximum(np.abs(expected).max(axis=1), 1.0)
    text = f"the connection of the model's space is that of its metric, as at {len(points)} random positions"
    if not (off <= AGREES).all():
        place = ", ".join(f"{x:.4g}" for x in points[int(np.where(np.isnan(off), np.inf, off).argmax())])
        return Hypothesis(text, "sampled", "undecided", place=f"({place}), where the two differ")
    # Analytic functions that agree near one point agree everywhere; others may differ at positions that were not drawn.
    return Hypothesis(text, "assumed" if analytic else "sampled")


def _stiffness(g, dg, ddg, f, df) -> Array:
    """−∇S times det g, as a covector of S: (2, 2), not symmetric if the force has no potential."""
    det = g[0, 0] * g[1, 1] - g[0, 1] * g[1, 0]
    return jnp.einsum("ijk,k->ij", lowered_christoffel(dg), _adjugate(g) @ f) - det * df


def _adjugate(g) -> Array:
    return jnp.array([[g[1, 1], -g[0, 1]], [-g[1, 0], g[0, 0]]])


def _curvature(g, dg, ddg) -> Array:
    """K (det g)² of the plane, by Gauss's equation in coordinates: `R_1212` times det g."""
    lowered, adjugate = lowered_christoffel(dg), _adjugate(g)
    det = g[0, 0] * g[1, 1] - g[0, 1] * g[1, 0]
    second = ddg[0, 1, 0, 1] - (ddg[0, 0, 1, 1] + ddg[1, 1, 0, 0]) / 2
    return det * second + lowered[0, 1] @ adjugate @ lowered[0, 1] - lowered[0, 0] @ adjugate @ lowered[1, 1]


class _Found(NamedTuple):
    """Proved bounds, and the largest squares (2,) of the lengths of the coordinates' differentials."""

    bounds: DistanceBounds
    widest: np.ndarray
    hypotheses: tuple[Hypothesis, ...]
    proofs: dict[str, Proof]


def _prove_bounds(known: _Model, speeds: np.ndarray, errors: np.ndarray, boxes: int) -> _Found:
    """Guess bounds at points, and prove them."""
    points, space = known.points(), known.model.space
    metrics = np.asarray(jax.vmap(space)(points[:, :2]))
    least = _constant_below(metrics)
    signs = np.array([[1.0, 1.0], [1.0, -1.0]])

    def guess(values) -> float:
        return float(np.max(values)) * (1 + MARGIN)

    speed2, error2 = (guess(np.einsum("kij,si,sj->ks", metrics, c, c)) for c in (signs * speeds, signs * errors))
    top = guess(np.linalg.det(metrics))
    widest = np.linalg.inv(metrics).max(axis=0).diagonal() * (1 + MARGIN)

    def det_of(g):
        return g[0, 0] * g[1, 1] - g[0, 1] * g[1, 0]

    def bending(g, dg, ddg, f, df):
        return _curvature(g, dg, ddg)[None, None]

    formed = known.form(bending).graph(points[0]).entries
    flat = formed.graph.is_zero(formed.outputs[0])
    bends = known.form(bending).at(np.asarray(points))[:, 0, 0] / np.linalg.det(metrics) ** 2
    spread = MARGIN * max(np.abs(bends).max(), 1e-6)
    low, high = (0.0, 0.0) if flat else (float(bends.min() - spread), float(bends.max() + spread))
    # If the curvature is never positive, the margin must not make its upper bound positive.
    high = 0.0 if bends.max() < -spread else high

    def stiffness(g, dg, ddg, f, df):
        return _stiffness(g, dg, ddg, f, df) / det_of(g)

    stiff = known.form(stiffness).at(np.asarray(points))
    roots = np.linalg.inv(np.linalg.cholesky(metrics))
    eigenvalues = np.linalg.eigvalsh(roots @ (stiff + stiff.transpose(0, 2, 1)) / 2 @ roots.transpose(0, 2, 1))
    room = MARGIN * max(np.abs(eigenvalues).max(), 1e-6)
    soft, hard = float(eigenvalues.min() - room), float(eigenvalues.max() + room)
    # The part of the force without potential, as a length: half of the difference divided by √det g.
    swirl = np.abs(stiff[:, 0, 1] - stiff[:, 1, 0]) / 2 / np.sqrt(np.linalg.det(metrics))
    swirl = float(swirl.max()) * (1 + MARGIN) + 3 * MARGIN * max(abs(soft), abs(hard))

    def on_metric(formula):
        return known.form(lambda g, dg, ddg, f, df: formula(g))

    def symmetric(g, dg, ddg, f, df):
        h = _stiffness(g, dg, ddg, f, df)
        return (h + h.T) / 2 / det_of(g)

    claims = {
        "the metric is at least a constant one": on_metric(lambda g: g - least),
        "its determinant is bounded": on_metric(lambda g: jnp.array([[top]]) - det_of(g)),
        "the change of a coordinate along a curve is bounded": on_metric(
            lambda g: jnp.diag(widest * det_of(g) - jnp.diag(_adjugate(g)))
        ),
        "the true speed is bounded": on_metric(lambda g: _below(g, speed2, signs * speeds)),
        "the first distance from the measurement is bounded": on_metric(lambda g: _below(g, error2, signs * errors)),
        "the curvature is bounded below": known.form(
            lambda g, dg, ddg, f, df: bending(g, dg, ddg, f, df) - low * det_of(g) ** 2
        ),
        "the curvature is bounded above": known.form(
            lambda g, dg, ddg, f, df: high * det_of(g) ** 2 - bending(g, dg, ddg, f, df)
        ),
        "−∇S is bounded below": known.form(lambda g, dg, ddg, f, df: symmetric(g, dg, ddg, f, df) - soft * g),
        "−∇S is bounded above": known.form(lambda g, dg, ddg, f, df: hard * g - symmetric(g, dg, ddg, f, df)),
        "what of the force has no potential is bounded": known.form(
            lambda g, dg, ddg, f, df: _swirl(_stiffness(g, dg, ddg, f, df) / det_of(g), swirl, det_of(g))
        ),
    }
    proofs = {
        text: prove(form, known.whole, boxes=boxes)
        for text, form in claims.items()
        if not ((flat and "curvature" in text) or (not errors.any() and "first distance" in text))
    }
    ratio = math.sqrt(top / np.linalg.det(least))
    injectivity = math.pi / math.sqrt(high * ratio) * (1 - 1e-9) if high > 0 else math.inf
    # Errors on circles must stay below half a turn, so that they are not wrapped.
    half_turns = [math.pi / math.sqrt(widest[i]) * (1 - 1e-9) for i in known.model.manifold.circles]
    injectivity = min([injectivity, *half_turns])
    bounds = DistanceBounds(
        math.sqrt(speed2) * (1 + 1e-12),
        math.sqrt(error2) * (1 + 1e-12),
        math.sqrt(speed2) * (1 + 1e-12),
        (soft - swirl, hard + swirl),
        (low, high),
        None,
        injectivity,
    )
    no_curvature = (Hypothesis("the curvature is zero as a formula", "proved"),) if flat else ()
    return _Found(bounds, widest, (*no_curvature, *_hypotheses(proofs)), proofs)


def _hypotheses(proofs: dict[str, Proof]) -> Iterator[Hypothesis]:
    for text, proof in proofs.items():
        # A bound that is wrong at a point was guessed too low, which does not refute the claim.
        verdict = "holds" if proof.verdict == "holds" else "undecided"
        yield Hypothesis(f"{text} ({proof.boxes} boxes)", "proved", verdict, place=proof.reason)


def _below(g, square: float, corners: np.ndarray) -> Array:
    """Bound the squared lengths of vectors; they are convex in the vector, so the largest is at a corner."""
    return jnp.diag(jnp.stack([square - corner @ g @ corner for corner in corners]))


def _swirl(h, bound: float, det) -> Array:
    skew = (h[0, 1] - h[1, 0]) / 2
    return (bound * bound * det - skew * skew)[None, None]


def _constant_below(metrics: np.ndarray) -> np.ndarray:
    """A constant metric below the metrics at points, with a margin; the mean of the cometrics gives its shape."""
    shape = np.linalg.inv(np.mean(np.linalg.inv(metrics), axis=0))
    root = np.linalg.inv(np.linalg.cholesky(shape))
    return shape * float(np.linalg.eigvalsh(root @ metrics @ root.T).min()) * (1 - MARGIN)
