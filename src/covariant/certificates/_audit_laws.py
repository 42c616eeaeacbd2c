"""Deviations from the laws of an intrinsic observer, at states that are given.

Nothing is measured by the formula it is to check: the error law takes no curvature, but derivatives of the observer's
own flow and of the connection; the curvature is found again in the way that geodesics part.

Source: Aghannan & Rouchon 2003, sections II to IV and appendix II; the derivative of the Lyapunov function carries a
factor ½.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.certificates._audit_places import AbstractPlace, compiled_quickly, exchange, traced_once
from covariant.models import Lagrangian, acceleration, friction
from covariant.observers import AbstractFlowObserver

STEP = 4e-3
"""Time between the geodesics of a second difference; their speed is 1 in coordinates."""
SHORT = 0.1
"""Time for which vectors are carried along a geodesic, at the same speed."""
STEPS = 4
"""Eighth-order steps of such a geodesic."""


class States(NamedTuple):
    """One random state a row, and what is needed to look around it; all (k, …)."""

    x: Array  # positions, elements of a group
    v: Float[Array, "k n"]
    y: Float[Array, "k n"]  # two vectors
    z: Float[Array, "k n"]
    unit: Float[Array, "k n"]  # one of unit length in coordinates
    u: Float[Array, "k m"]
    bend: Float[Array, "k 2 n n"]  # of a random chart, and where in it the state is
    centre: Float[Array, "k n"]


class FlowDeviations(NamedTuple):
    """Relative deviations (k,) from the laws along the observer's flow."""

    plant: Array
    error: Array
    lyapunov: Array


class GeometryDeviations(NamedTuple):
    """Relative deviations (k,) from the laws of the geometry, and sectional curvatures (k,)."""

    metric: Array
    torsion: Array
    transport: Array
    curvature: Array
    sectional: Array


def slope(place: AbstractPlace, observer: AbstractFlowObserver, x: Array, v: Vector, u: Array, y: Array):
    """`(q̂', v̂')` of the estimate (x, v) under the input u, y being measured."""
    state = observer.init(y)._replace(**{place.slot: x, "v": v})
    found = observer.flow(jnp.zeros((), v.dtype), state, u, y)
    return getattr(found, place.slot), found.v


def change(function, *, aux: bool = False):
    """A function of one number and its derivative, at zero."""
    return jax.jvp(function, (jnp.zeros(()),), (jnp.ones(()),), has_aux=aux)


@compiled_quickly
def along_the_flow(
    place: AbstractPlace,
    observer: AbstractFlowObserver,
    alpha: Scalar,
    beta: Scalar,
    q: Float[Array, "2 2"],
    states: States,
) -> FlowDeviations:
    """At q̂ = q and any velocity: the estimate moves as the plant; law (10); V' for the matrix Q."""
    place, observer = traced_once(place), traced_once(observer)

    def one(states: States) -> FlowDeviations:
        x, v, u, xi, delta = states.x, states.v, states.u, states.y, states.z

        def norm(a):
            return place.norm(x, a)

        def undamped(s):  # the dissipation at the estimate is the one addition to the law
            near, moved = place.nudge(x, s * xi), v + s * delta
            w, a = slope(place, observer, near, moved, u, x)
            return w, a - friction(place.model, near, moved)

        (w, a), (w_change, a_change) = change(undamped)
        xi_rate = w_change + place.bracket(xi, w)

        def along(s):
            """ζ and V of the variation that the flow carries along."""
            at, xi_now = place.nudge(x, s * w), xi + s * xi_rate
            zeta = delta + s * a_change + place.connection(at, xi_now, v + s * a)
            gram = place.gram(at, jnp.stack([xi_now, zeta]))
            return zeta, jnp.sum(q * gram) / 2

        (zeta, _), (zeta_rate, fall) = change(along)
        turned, carried = place.connection(x, w, xi), place.connection(x, w, zeta)
        first = xi_rate + turned - (zeta - alpha * xi)
        second = zeta_rate + carried + beta * xi
        # Against the terms that cancel, so that rounding counts as what it is.
        lengths = jnp.stack([norm(xi), norm(zeta)])
        sizes = jnp.stack(
            [
                norm(xi_rate) + norm(turned) + lengths[1] + alpha * lengths[0],
                norm(a_change) + norm(zeta_rate - a_change) + norm(carried) + beta * lengths[0],
            ]
        )
        damping, bent = friction(place.model, x, v), place.connection(x, v, v)
        plant = acceleration(place.model, jnp.zeros(()), x, v, u)
        parts = norm(plant) + norm(a) + norm(damping) + norm(bent)
        return FlowDeviations(
            jnp.maximum(norm(w - v) / norm(v), norm(a + damping - plant) / parts),
            jnp.max(jnp.stack([norm(first), norm(second)]) / sizes),
            jnp.abs(fall + lengths @ lengths / 2) / (lengths @ jnp.abs(q) @ sizes),
        )

    return jax.lax.map(one, states)


@compiled_quickly
def of_the_geometry(place: AbstractPlace, states: States) -> GeometryDeviations:
    """The connection is metric and symmetric, transport keeps lengths, geodesics part as the curvature says."""
    place = traced_once(place)

    def one(states: States) -> GeometryDeviations:
        x, a, b, c, e = states.x, states.v, states.y, states.z, states.unit

        def norm(a):
            return place.norm(x, a)

        along_b, along_c = place.connection(x, a, b), place.connection(x, a, c)
        changed = change(lambda s: place.inner(place.nudge(x, s * a), b, c))[1]
        metric = jnp.abs(changed - place.inner(x, along_b, c) - place.inner(x, b, along_c))
        metric = metric / (jnp.abs(changed) + norm(along_b) * norm(c) + norm(b) * (norm(along_c) + norm(c)))
        swapped, bracket = place.connection(x, b, a), place.bracket(a, b)
        torsion = norm(along_b - swapped - bracket)
        torsion = torsion / (norm(along_b) + norm(swapped) + norm(bracket) + norm(a) * norm(b))

        # Vectors of unit length, so that a badly scaled metric is looked at alike in all directions.
        frame = jnp.eye(a.shape[0], dtype=a.dtype)
        frame = frame / jax.vmap(norm)(frame)[:, None]
        b = b / norm(b)

        def carried(t):
            """In the parallel frame: the field by which geodesics part that start side by side, and its own products.

            Each starts from its x with the velocity e carried over, to first order, from here.
            """

            def neighbour(s):
                start, velocity = place.nudge(x, s * b), e - s * place.connection(x, b, e)
                return place.geodesic(start, t * velocity, frame, STEPS)

            (end, moved), (parted, _) = change(neighbour)
            return moved @ place.covector(end, place.tangent(end, parted)), place.gram(end, moved)

        times = jnp.array([-2 * STEP, -STEP, 0.0, STEP, 2 * STEP, SHORT])
        field, gram = jax.lax.map(carried, times)
        second = jnp.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / (12 * STEP**2) @ field[:5]
        jacobi = place.curvature(x, b, e, e)
        parting = jnp.max(jnp.abs(second + frame @ place.covector(x, jacobi)))
        area = place.inner(x, e, e) - place.inner(x, b, e) ** 2
        return GeometryDeviations(
            metric,
            torsion,
            jnp.max(jnp.abs(gram[-1] - gram[2])),
            parting / (1 + norm(jacobi)),
            place.inner(x, b, jacobi) / area,
        )

    return jax.lax.map(one, states)


def _spread(one, states: States, errors: Float[Array, "e"]) -> Float[Array, "e k"]:
    """A function of state and size of the error, over all of both."""
    k, e = states.v.shape[0], errors.shape[0]
    tiled = jax.tree.map(lambda a: jnp.tile(a, (e,) + (1,) * (a.ndim - 1)), states)
    return jax.lax.map(lambda both: one(*both), (tiled, jnp.repeat(errors, k))).reshape(e, k)


def _difference(place: AbstractPlace, gains, x, v, error, one, two) -> Scalar:
    """How far two slopes are from each other, relative to the correction that the error calls for."""
    (alpha, beta), w, a = gains, one[0] - two[0], one[1] - two[1]
    gap = alpha * place.norm(x, w) + place.norm(x, a + place.connection(x, v, w))
    return gap / ((alpha**2 + beta) * place.norm(x, error))


@compiled_quickly
def between_charts(
    place: AbstractPlace,
    observer: AbstractFlowObserver,
    gains: tuple[Scalar, Scalar],
    states: States,
    errors: Float[Array, "e"],
) -> Float[Array, "e k"]:
    """Relative differences of the observer's slopes in its own chart and in a random cubic one, seen in the first.

    The chart is `q = y + ψ(z) − ψ(centre)` with `ψ(z) = z + A z² + B z³`, powers by components.
    """
    place, observer = traced_once(place), traced_once(observer)
    model = place.model

    def one(states: States, error: Scalar) -> Scalar:
        y, v, u, centre = states.x, states.v, states.u, states.centre

        def bent(z):
            return z + states.bend[0] @ z**2 + states.bend[1] @ z**3

        def chart(z):
            return y + bent(z) - bent(centre)

        def push(z, w):
            return jax.jvp(chart, (z,), (w,))[1]

        def pull(z, covector):
            return jax.vjp(chart, z)[1](covector)[0]

        @jax.jit  # so that it is traced once, and not wherever a derivative of it is taken
        def metric(z):
            jacobian = jax.jacfwd(chart)(z)
            return jacobian.T @ model.metric(chart(z)) @ jacobian

        rewritten = Lagrangian(
            metric,
            lambda z: model.potential(chart(z)),
            lambda t, z, u: pull(z, model.force(t, chart(z), u)),
            lambda z, w: pull(z, model.dissipation(chart(z), push(z, w))),
            inputs=model.inputs,
        )
        estimate = centre + error * states.unit
        there = slope(exchange(place, rewritten), exchange(observer, rewritten), estimate, v, u, centre)
        (x, velocity), pushed = jax.jvp(lambda z, w: (chart(z), push(z, w)), (estimate, v), there)
        here = slope(place, observer, x, velocity, u, y)
        return _difference(place, gains, x, velocity, x - y, here, pushed)

    return _spread(one, states, errors)


@compiled_quickly
def between_observers(
    place: AbstractPlace,
    observer: AbstractFlowObserver,
    gains: tuple[Scalar, Scalar],
    states: States,
    errors: Float[Array, "e"],
) -> Float[Array, "e k"]:
    """Relative differences of the slopes of the observer and of its counterpart, approximate or exact."""
    place, observer = traced_once(place), traced_once(observer)
    pair = observer, place.counterpart(observer, *gains)

    def one(states: States, error: Scalar) -> Scalar:
        away = error * states.unit
        x = place.move(states.x, away)
        one, two = (slope(place, each, x, states.v, states.u, states.x) for each in pair)
        return _difference(place, gains, x, states.v, away, one, two)

    return _spread(one, states, errors)


def order_of(relative: Float[np.ndarray, "e k"], errors: Float[np.ndarray, "e"], floor: float) -> float | None:
    """The power of the error with which differences vanish that are given relative to it; None below the floor."""
    typical = np.sqrt(np.mean(relative**2, axis=1))
    clear = ~(typical < floor)
    if clear.sum() < 2:
        return None
    if not np.isfinite(typical).all():
        return float("nan")
    return float(1 + np.polyfit(np.log(errors[clear]), np.log(typical[clear]), 1)[0])
