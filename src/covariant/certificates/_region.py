"""An intrinsic observer on a region, as functions of boxed variables: what a machine proves about it.

The variables are the estimate, the error of its position and the force on the system, each in a box. Nothing else
enters: the source `S = g⁻¹ f` at the measured position is a known function of the force f, whatever the input, the
potential and the time that made it. On a group the estimated configuration does not enter either, by symmetry, and a
model whose friction breaks the symmetry is refused.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Matrix, Scalar, Vector
from covariant.certificates._contraction import StateMetric, contraction_matrix, lengths
from covariant.certificates._form import Form, Values, as_form, formed
from covariant.certificates._prove import Box, check_box, show_conditions
from covariant.certificates._tangent import TwoByTwo, tangent_metric
from covariant.lowering import Conditions, enclose, expand, lower, numbers
from covariant.models import MechanicalSystem, applied_force, input_count, resistance
from covariant.observers import Geodesic, Intrinsic, second_order

Intrinsics = Intrinsic | Geodesic


def _nothing() -> Matrix:
    return jnp.zeros((0, 0))


class Point(NamedTuple):
    """What a point z of a region stands for: the flow with the measurement held, the metric, and a state x (2n,).

    Of intrinsic observers, `reach()` (2n, 2n): the changes of position error and velocity that the vectors of the
    metric's frame bring; `offset()` (n, n): the change of the position error that an error of the measurement brings.
    """

    flow: Callable[[Scalar, Vector], Array]
    metric: StateMetric
    x: Vector
    reach: Callable[[], Matrix] = _nothing
    offset: Callable[[], Matrix] = _nothing


class Subject(NamedTuple):
    """An observer under proof, and the names and units of the 4n variables: q̂, v̂, error, force (without q̂ on a group).

    `at` takes a point z of them apart.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    at: Callable[[Vector], Point]


def subject(observer: Intrinsics, q: TwoByTwo) -> Subject:
    """The observer on any region, in the metric that the matrix q (2, 2) makes of that of its model.

    Raises `TypeError` for another kind of observer, `ValueError` for a space where none is known.
    """
    if not isinstance(observer, Intrinsics):
        raise TypeError(f"only intrinsic observers have this metric, Intrinsic and Geodesic; got {observer!r}")
    _need_friction_alone(observer.model)
    space = observer.model.space
    if space.manifold.commuting:
        return _in_coordinates(observer, q)
    if space.homogeneous and isinstance(observer, Intrinsic):
        return _in_the_body(observer, q)
    raise ValueError(
        "a region is a box of coordinates, or for Intrinsic of velocities alone where the metric is the same "
        f"everywhere; {type(observer).__name__} on {space.manifold} is not covered"
    )


def contraction(subject: Subject, rate: float) -> Form:
    """`z -> −(F_ΘᵀN + Ṅ + N F_Θ) − rate N`: positive definite where squared lengths shrink at the rate [1/s]."""

    def numbers(z):
        point, t = subject.at(z), jnp.zeros((), z.dtype)
        return -contraction_matrix(point.flow, point.metric, t, point.x) - rate * point.metric.gram(t, point.x)

    return changing(subject, lambda coframe, gram, change: -change - rate * gram, numbers)


def changing(subject: Subject, formula: Callable[[Array, Array, Array], Array], numbers: Callable) -> Form:
    """A formula of Θ, of N, and of `F_ΘᵀN + Ṅ + N F_Θ`, the change of squared lengths, for a proof."""

    def parts(slopes, nodes, count):
        flow, coframe, frame, gram, *_ = nodes
        state = range(1, count + 1)
        along = {0: slopes.graph.constant(1.0), **dict(zip(state, flow.tolist(), strict=True))}
        return (
            coframe,
            frame,
            gram,
            slopes.each(flow, state, frame),
            slopes.along(coframe, along),
            slopes.along(gram, along),
        )

    def whole(coframe, frame, gram, moved, turn, change):
        return formula(coframe, gram, lengths(gram, change, turn @ frame + coframe @ moved))

    return formed(values(subject), lambda z: subject.at(z).x, parts, whole, numbers)


def values(subject: Subject) -> Values:
    """All that is claimed of a subject is made of this: the flow, Θ, Θ⁻¹, N, `reach` and `offset`, and derivatives."""

    def at(t, x, z):
        point = subject.at(z)
        metric = point.metric
        parts = point.flow(t, x), metric.coframe(t, x), metric.frame(t, x), metric.gram(t, x)
        return *parts, point.reach(), point.offset()

    return at


def reach(subject: Subject, i: int, square: float) -> Form:
    """`z -> square N − r rᵀ`, r being row i of `reach`.

    Positive definite where a curve of length ℓ changes that entry of (error, velocity) by less than `ℓ √square`.
    """

    def matrix(z):
        point, t = subject.at(z), jnp.zeros((), z.dtype)
        row = point.reach()[i]
        return square * point.metric.gram(t, point.x) - jnp.outer(row, row)

    return as_form(matrix)


def squares(subject: Subject, z: Vector) -> Float[Array, "two_n"]:
    """The least `square` of each row of `reach` at z."""
    point = subject.at(z)
    gram, rows = point.metric.gram(jnp.zeros((), z.dtype), point.x), point.reach()
    return jnp.sum(rows * solve(gram, rows.T).T, axis=1)


def disturbed(subject: Subject, sizes: Float[np.ndarray, "two_n"], square: float) -> Form:
    """`z -> square I − BᵀMB`, B being how the flow changes with errors of the measurement and of the force, by size.

    Positive definite where errors `δ = sizes w` with |w| ≤ 1 (in the Euclidean norm) change it by a vector shorter than
    `√square`. The first n sizes are those of the measured position, the others those of the force.
    """
    n = len(sizes) // 2

    def parts(slopes, nodes, count):
        last = 1 + count + len(subject.names)
        flow, coframe, _, gram, _, offset = nodes
        return coframe, gram, offset, slopes.each(flow, range(last - 2 * n, last))

    def formula(coframe, gram, offset, change):
        moved = jnp.concatenate([change[:, :n] @ offset, change[:, n:]], axis=1) * jnp.asarray(sizes)[None]
        return square * jnp.eye(2 * n) - (coframe @ moved).T @ gram @ (coframe @ moved)

    def numbers(z):
        point, t = subject.at(z), jnp.zeros((), z.dtype)
        change = jax.jacfwd(lambda z: subject.at(z).flow(t, point.x))(z)[:, -2 * n :]
        return formula(point.metric.coframe(t, point.x), point.metric.gram(t, point.x), point.offset(), change)

    return formed(values(subject), lambda z: subject.at(z).x, parts, formula, numbers)


def _in_coordinates(observer: Intrinsics, q: TwoByTwo) -> Subject:
    model = observer.model
    n = _dimension(model)
    driven = MechanicalSystem(model.space, None, None, functools.partial(_friction_alone, model))
    bare = _with_model(observer, driven)
    metric = tangent_metric(model.space, q)

    def at(z):
        place, velocity, error, force = jnp.split(z, 4)
        measured = place - error

        def flow(t, x):
            state = bare.init(x[:n])._replace(q=x[:n], v=x[n:], t=t)
            change = bare.flow(t, state, force, measured)
            return jnp.concatenate([change.q, change.v])

        x = jnp.concatenate([place, velocity])
        return Point(
            flow,
            metric,
            x,
            lambda: metric.frame(jnp.zeros((), z.dtype), x),
            lambda: -jnp.eye(n, dtype=z.dtype),
        )

    names = model.coordinates or tuple(f"q{i + 1}" for i in range(n))
    units = model.units or ("",) * n
    rates = tuple(f"{unit}/s" if unit else "" for unit in units)
    return Subject(
        (*names, *(f"v_{k}" for k in names), *(f"e_{k}" for k in names), *(f"f_{k}" for k in names)),
        (*units, *rates, *units, *("",) * n),
        at,
    )


def _in_the_body(observer: Intrinsic, q: TwoByTwo) -> Subject:
    model, space, manifold = observer.model, observer.model.space, observer.model.manifold
    _need_symmetry(model)
    origin = manifold.origin()
    inertia = np.array(space(origin))
    n = len(inertia)

    def each(linear, dtype):
        return jax.vmap(linear, out_axes=1)(jnp.eye(n, dtype=dtype))

    # Around an estimate the chart is that of the retraction, and everything is looked at at θ = 0.
    def frames(x, sign):
        theta, v = jnp.split(x, 2)
        body = each(functools.partial(manifold.frame_velocity, origin, theta), x.dtype)
        turn = each(lambda e: space.connection(origin, e, v), x.dtype)
        lower = turn @ body if sign > 0 else -turn
        upper = body if sign > 0 else each(functools.partial(manifold.local_rate, origin, theta), x.dtype)
        return jnp.block([[upper, jnp.zeros((n, n), x.dtype)], [lower, jnp.eye(n, dtype=x.dtype)]])

    def gram(t, x):
        return jnp.asarray(np.kron(q / 2, inertia), x.dtype)

    length = StateMetric(lambda t, x: frames(x, 1), lambda t, x: frames(x, -1), gram)

    def at(z):
        velocity, error, force = jnp.split(z, 3)

        def flow(t, x):
            theta, v = jnp.split(x, 2)
            # log(exp(−θ) exp(−e)) to first order in θ, without what the logarithm decides by matrix entries. It is an
            # identity for errors whose logarithm is unique.
            towards = -error - manifold.local_rate(origin, error, theta)
            at = manifold.origin(z.dtype)
            xi = -towards if observer.order == 1 else second_order(space, at, -towards)
            source = space.raise_(at, force)
            rubbing = space.raise_(at, _friction_alone(model, at, v))
            drive = observer.bend(at, source - space.connection(at, xi, source), xi, v)
            w, v_dot = observer.rates(at, v, xi, drive + rubbing)
            return jnp.concatenate([manifold.local_rate(origin, theta, w), v_dot])

        x = jnp.concatenate([jnp.zeros(n, z.dtype), velocity])

        def reach():
            away = each(functools.partial(manifold.local_rate, origin, error), z.dtype)
            rows = jnp.concatenate([away, jnp.zeros((n, n), z.dtype)], axis=1)
            return jnp.concatenate([rows, length.frame(jnp.zeros((), z.dtype), x)[n:]])

        def offset():
            return -each(functools.partial(manifold.local_rate, origin, -error), z.dtype)

        return Point(flow, length, x, reach, offset)

    names, units = model.velocities, model.velocity_units
    turned = tuple(unit.removesuffix("/s") for unit in units)
    return Subject(
        (*names, *(f"e_{k}" for k in names), *(f"f_{k}" for k in names)),
        (*units, *turned, *("",) * n),
        at,
    )


def _friction_alone(model: MechanicalSystem, q: Array, v: Vector) -> Vector:
    """The dissipation of a model whose friction reads neither time nor input."""
    n = v.shape[0]
    return resistance(model, jnp.zeros((), v.dtype), q, v, jnp.zeros(input_count(model, n), v.dtype))


def _need_friction_alone(model: MechanicalSystem) -> None:
    """Raise `ValueError` where the dissipation depends on time or input: no region says how far those go in it."""
    q = jnp.zeros(_dimension(model)) if model.manifold.commuting else model.manifold.origin()
    v = model.manifold.zero(q)
    u = jnp.zeros(input_count(model, v.size))
    rubbing = lower(functools.partial(resistance, model), jnp.zeros(()), q, v, u, real=True)
    assert rubbing.conditions is not None
    read = {
        node.value for graph in (rubbing.graph, rubbing.conditions.graph) for node in graph.nodes if node.op == "input"
    }
    found = ["time"] * (0 in read) + [f"u{i + 1}" for i in range(u.size) if 1 + q.size + v.size + i in read]
    if found:
        raise ValueError(
            f"the dissipation of this model depends on {', '.join(found)}; only friction of position and velocity is "
            "covered by a proof"
        )


def _with_model(observer, model):
    fields = {name: getattr(observer, name) for name in type(observer).__dataclass_fields__}
    return type(observer)(**(fields | {"model": model}))


def _dimension(model: MechanicalSystem) -> int:
    if not model.coordinates:
        raise ValueError("the model must name its coordinates, so that a region can; give Lagrangian(coordinates=...)")
    return len(model.coordinates)


def _need_symmetry(model: MechanicalSystem) -> None:
    """Raise `ValueError` where friction or inertia do not let the estimated configuration drop out."""
    origin = model.manifold.origin()
    entries, rest = origin.size, model.manifold.zero(origin)
    rubbing = lower(functools.partial(_friction_alone, model), origin, rest, real=True)
    assert rubbing.conditions is not None
    read = {
        node.value for graph in (rubbing.graph, rubbing.conditions.graph) for node in graph.nodes if node.op == "input"
    }
    indices = [np.unravel_index(k, origin.shape) for k in range(entries) if k in read]
    places = ["g" + "".join(str(i + 1) for i in index) for index in indices]
    if places:
        raise ValueError(
            f"the friction of this model depends on where the body is, on {', '.join(places)} of its matrix; on a "
            "group that is not covered: write the system as a Lagrangian in coordinates"
        )
    momentum = lower(lambda a: model.space.lower(origin, a), rest)
    bent = expand(momentum, range(rest.size), 2)
    second = np.ravel(bent.nodes()[2]).tolist()
    if numbers(momentum, np.zeros(rest.size)).any() or not all(bent.graph.is_zero(node) for node in second):
        raise ValueError("the inertia of this model is not a linear map; on a group that is not covered")


def check_unique(observer: Intrinsics, error: Float[np.ndarray, "n"]) -> None:
    """Raise `ValueError` for errors of positions up to which the way to the measurement is not unique, or not known.

    Below half a turn, of each circle, and of each rotation at the farthest corner of the box.
    """
    if isinstance(observer, Geodesic):
        raise ValueError(
            "the exact observer searches its geodesic, and that it finds the shortest one is not proved; certify the "
            "approximate one, Intrinsic"
        )
    model = observer.model
    if model.manifold.rotations is None:
        raise ValueError(
            f"how far the logarithm of {type(model.manifold).__name__} is unique is not known; no proof there"
        )
    for turn in model.manifold.rotations:
        farthest = math.sqrt(math.fsum(float(error[i]) ** 2 for i in turn)) * (1 + 1e-12)
        if not farthest < math.pi * (1 - 1e-12):
            names = model.coordinates or model.velocities
            raise ValueError(
                f"the error of {', '.join(names[i] for i in turn)} must be below π, at the farthest corner of its box; "
                f"it is up to {farthest:g} there"
            )


def force_bounds(
    model: MechanicalSystem, places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]
) -> Float[np.ndarray, "2 n"]:
    """Bounds of `force − grad U` over the box of positions, or on a group of matrix entries, of inputs and of times.

    By interval arithmetic, outward rounded. The force may jump there. Raises `ValueError` where it has no bound, or is
    not defined everywhere.
    """
    given = _given_box(places, inputs, times)

    def force(t, q, u):
        return applied_force(model, t, q, u)

    lowered = lower(force, jnp.zeros(()), jnp.zeros(_shape(model, places)), jnp.zeros(inputs.shape[1]), real=True)
    assert lowered.conditions is not None
    defined = lowered.conditions._replace(
        conditions=tuple(c for c in lowered.conditions.conditions if c.kind == "true")
    )
    _need_conditions("the force of the model is not defined", defined, given)
    found = enclose(lowered, given.low[None], given.high[None])
    bounds = np.concatenate([found.low, found.high])
    if not np.isfinite(bounds).all():
        raise ValueError(f"the force of the model has no bound over {places}; make the box smaller")
    return bounds


def force_slopes(
    model: MechanicalSystem, places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]
) -> Float[np.ndarray, "n n"]:
    """Bounds of |∂f_i/∂q_j| over the same boxes; on a group along the directions of the body.

    Raises `ValueError` where the force has no such bound, as where it jumps.
    """
    given, shape = _given_box(places, inputs, times), _shape(model, places)
    n = model.manifold.zero(jnp.zeros(shape)).size

    def force(t, q, u, step):
        return applied_force(model, t, model.manifold.nudged(q, step), u)

    lowered = lower(force, jnp.zeros(()), jnp.zeros(shape), jnp.zeros(inputs.shape[1]), jnp.zeros(n), real=True)
    assert lowered.conditions is not None
    still = np.zeros(n)
    whole = Box(
        (*given.names, *("",) * n),
        (*given.units, *("",) * n),
        np.concatenate([given.low, still]),
        np.concatenate([given.high, still]),
    )
    _need_conditions("the force of the model jumps, or is not defined", lowered.conditions, whole)
    steps = range(len(given.low), len(whole.low))
    found = enclose(expand(lowered._replace(conditions=None), steps, 1), whole.low[None], whole.high[None])
    bounds = np.maximum(np.abs(found.low), np.abs(found.high))[0, n:].reshape(n, n).T
    if not np.isfinite(bounds).all():
        raise ValueError(f"the slope of the model's force has no bound over {places}; make the box smaller")
    return bounds


def _shape(model: MechanicalSystem, places: Box) -> tuple[int, ...]:
    return places.low.shape if model.manifold.commuting else jax.eval_shape(model.manifold.origin).shape


def _given_box(places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]) -> Box:
    """Time, positions and inputs as one box."""
    names = ("t", *places.names, *(f"u{i + 1}" for i in range(inputs.shape[1])))
    low, high = (
        np.concatenate([[t], ends, u]) for t, ends, u in zip(times, (places.low, places.high), inputs, strict=True)
    )
    return check_box(Box(names, ("s", *places.units, *("",) * inputs.shape[1]), low, high))


def _need_conditions(what: str, conditions: Conditions, domain: Box) -> None:
    reason = show_conditions(conditions, domain)
    if reason:
        raise ValueError(f"{what} everywhere in the region: {reason}")
