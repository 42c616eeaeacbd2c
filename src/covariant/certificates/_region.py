"""An intrinsic observer on a region, as functions of boxed variables: what a machine proves about it.

The variables are the estimate, the error of its position and the force on the system, each in a box. Nothing else
enters: the source `S = g⁻¹ f` at the measured position is a known function of the force f, whatever the input, the
potential and the time that made it. On a group the estimated configuration does not enter either, by symmetry.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Matrix, Scalar, Vector
from covariant.certificates._contraction import StateMetric, contraction_matrix
from covariant.certificates._prove import Box
from covariant.certificates._tangent import TwoByTwo, tangent_metric
from covariant.lowering import enclose, lower
from covariant.models import GroupSystem, Lagrangian, applied_force
from covariant.observers import Geodesic, Group, Intrinsic

Intrinsics = Intrinsic | Geodesic | Group


class Point(NamedTuple):
    """What a point z of a region stands for: the flow with the measurement held, the metric, and a state x (2n,).

    `reach` (2n, 2n): the changes of position error and velocity that the vectors of the metric's frame bring.
    """

    flow: Callable[[Scalar, Vector], Array]
    metric: StateMetric
    x: Vector
    reach: Matrix


class Subject(NamedTuple):
    """An observer under proof, and the names and units of the 4n variables: q̂, v̂, error, force (without q̂ on a group).

    `at` takes a point z of them apart.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    at: Callable[[Vector], Point]


def subject(observer: Intrinsics, q: TwoByTwo) -> Subject:
    """The observer on any region, in the metric that the matrix q (2, 2) makes of that of its model.

    Raises `TypeError` for another kind of observer.
    """
    if isinstance(observer, Group):
        return _on_group(observer, q)
    if isinstance(observer, Intrinsic | Geodesic):
        return _in_coordinates(observer, q)
    raise TypeError(f"only intrinsic observers have this metric, Intrinsic, Geodesic and Group; got {observer!r}")


def contraction(subject: Subject, rate: float) -> Callable[[Vector], Matrix]:
    """`z -> −(F_ΘᵀN + Ṅ + N F_Θ) − rate N`: positive definite where squared lengths shrink at the rate [1/s]."""

    def matrix(z):
        point, t = subject.at(z), jnp.zeros((), z.dtype)
        return -contraction_matrix(point.flow, point.metric, t, point.x) - rate * point.metric.gram(t, point.x)

    return matrix


def reach(subject: Subject, i: int, square: float) -> Callable[[Vector], Matrix]:
    """`z -> square N − r rᵀ`, r being row i of `reach`.

    Positive definite where a curve of length ℓ changes that entry of (error, velocity) by less than `ℓ √square`.
    """

    def matrix(z):
        point, t = subject.at(z), jnp.zeros((), z.dtype)
        return square * point.metric.gram(t, point.x) - jnp.outer(point.reach[i], point.reach[i])

    return matrix


def squares(subject: Subject, z: Vector) -> Float[Array, "two_n"]:
    """The least `square` of each row of `reach` at z."""
    point = subject.at(z)
    gram = point.metric.gram(jnp.zeros((), z.dtype), point.x)
    return jnp.sum(point.reach * solve(gram, point.reach.T).T, axis=1)


def _in_coordinates(observer: Intrinsic | Geodesic, q: TwoByTwo) -> Subject:
    model = observer.model
    n = _dimension(model)
    driven = Lagrangian(model.metric, _no_potential, None, model.dissipation, model.circles)
    bare = _with_model(observer, driven)
    metric = tangent_metric(model.metric, q)

    def at(z):
        place, velocity, error, force = jnp.split(z, 4)
        measured = place - error

        def flow(t, x):
            state = bare.init(x[:n])._replace(q=x[:n], v=x[n:], t=t)
            change = bare.flow(t, state, force, measured)
            return jnp.concatenate([change.q, change.v])

        x = jnp.concatenate([place, velocity])
        return Point(flow, metric, x, metric.frame(jnp.zeros((), z.dtype), x))

    names = model.coordinates or tuple(f"q{i + 1}" for i in range(n))
    units = model.units or ("",) * n
    rates = tuple(f"{unit}/s" if unit else "" for unit in units)
    return Subject(
        (*names, *(f"v_{k}" for k in names), *(f"e_{k}" for k in names), *(f"f_{k}" for k in names)),
        (*units, *rates, *units, *("",) * n),
        at,
    )


def _on_group(observer: Group, q: TwoByTwo) -> Subject:
    model, group = observer.model, observer.model.group
    n = group.dimension
    metric = model.metric
    inertia = np.array(jax.vmap(metric.inertia)(jnp.eye(n)))
    driven = GroupSystem(group, metric.inertia, dissipation=model.dissipation)
    bare = _with_model(observer, driven)

    def each(linear, dtype):
        return jax.vmap(linear, out_axes=1)(jnp.eye(n, dtype=dtype))

    # Around an estimate g the chart is g exp(θ), and everything is looked at at θ = 0.
    def frames(x, sign):
        theta, v = jnp.split(x, 2)
        body = each(functools.partial(group.right_jacobian, theta), x.dtype)
        turn = each(lambda e: metric.connection(e, v), x.dtype)
        lower = turn @ body if sign > 0 else -turn
        upper = body if sign > 0 else each(functools.partial(group.right_jacobian_inverse, theta), x.dtype)
        return jnp.block([[upper, jnp.zeros((n, n), x.dtype)], [lower, jnp.eye(n, dtype=x.dtype)]])

    def gram(t, x):
        return jnp.asarray(np.kron(q / 2, inertia), x.dtype)

    length = StateMetric(lambda t, x: frames(x, 1), lambda t, x: frames(x, -1), gram)

    def at(z):
        velocity, error, force = jnp.split(z, 3)
        measured = group.exp(-error)  # seen from the estimate

        def flow(t, x):
            theta, v = jnp.split(x, 2)
            state = bare.init(group.identity(x.dtype))._replace(g=group.exp(theta), v=v, t=t)
            change = bare.flow(t, state, force, measured)
            return jnp.concatenate([group.right_jacobian_inverse(theta, change.g), change.v])

        x = jnp.concatenate([jnp.zeros(n, z.dtype), velocity])
        away = each(functools.partial(group.right_jacobian_inverse, error), z.dtype)
        rows = jnp.concatenate([away, jnp.zeros((n, n), z.dtype)], axis=1)
        return Point(flow, length, x, jnp.concatenate([rows, length.frame(jnp.zeros((), z.dtype), x)[n:]]))

    names, units = model.velocities, model.units
    turned = tuple(unit.removesuffix("/s") for unit in units)
    return Subject(
        (*names, *(f"e_{k}" for k in names), *(f"f_{k}" for k in names)),
        (*units, *turned, *("",) * n),
        at,
    )


def _with_model(observer, model):
    fields = {name: getattr(observer, name) for name in type(observer).__dataclass_fields__}
    return type(observer)(**(fields | {"model": model}))


def _no_potential(q):
    return jnp.zeros((), q.dtype)


def _dimension(model: Lagrangian) -> int:
    if not model.coordinates:
        raise ValueError("the model must name its coordinates, so that a region can; give Lagrangian(coordinates=...)")
    return len(model.coordinates)


def force_bounds(
    model: Lagrangian | GroupSystem, places: Box, inputs: Float[np.ndarray, "2 m"], times: tuple[float, float]
) -> Float[np.ndarray, "2 n"]:
    """Bounds of `force − grad U` over the box of positions, or on a group of matrix entries, of inputs and of times.

    By interval arithmetic, outward rounded. Raises `ValueError` where the force has no bound there.
    """
    shape = places.low.shape if isinstance(model, Lagrangian) else (model.group.order,) * 2

    def force(t, q, u):
        return applied_force(model, t, q, u)

    lowered = lower(force, jnp.zeros(()), jnp.zeros(shape), jnp.zeros(inputs.shape[1]))
    low, high = (
        np.concatenate([[t], ends, u])[None]
        for t, ends, u in zip(times, (places.low, places.high), inputs, strict=True)
    )
    found = enclose(lowered, low, high)
    bounds = np.concatenate([found.low, found.high])
    if not np.isfinite(bounds).all():
        raise ValueError(f"the force of the model has no bound over {places}; make the box smaller")
    return bounds
