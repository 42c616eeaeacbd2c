"""Deviations from the laws of an intrinsic observer, at given states.

No law is measured by the formula that it checks: the error law is computed without curvature, from derivatives of the
observer's own flow and of the connection; the curvature is compared with the separation of neighbouring geodesics.

Source: Aghannan & Rouchon 2003, sections II to IV and appendix II; the derivative of the Lyapunov function carries a
factor ½.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.geometry import AbstractSpace, Budget, Metric
from covariant.lowering import along, change
from covariant.models import MechanicalSystem, acceleration, friction, in_chart
from covariant.observers import AbstractFlowObserver, AbstractObserver, Geodesic, Intrinsic

NEAR = Budget(newton=0, steps=1)
"""Budget for a geodesic to second order in the error, which suffices for differences of second order."""
# The difference errs by h⁴/90 = 3e-12 of a sixth derivative, and rounding adds (64/12)u/h² = 4e-11.
STEP = 4e-3
"""Time step of the second difference along a geodesic, whose speed is 1 in coordinates."""
SHORT = 0.1
"""Time for which vectors are transported along a geodesic, whose speed is also 1."""
STEPS = 4
"""Number of eighth-order steps along a geodesic."""

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled_quickly(function: _Function) -> _Function:
    """Compile a function that runs once, with little optimisation: most of the time of an audit is compilation."""
    options = {"xla_backend_optimization_level": 0}
    return eqx.filter_jit(function, compiler_options=options)  # pyright: ignore[reportCallIssue]


class States(NamedTuple):
    """Random states, one in each row, with directions in which the laws are examined around them.

    Attributes:
        x: configurations (k, …).
        v: velocities (k, n).
        y, z: two random vectors (k, n).
        unit: vectors (k, n) of unit length in coordinates.
        u: inputs (k, m).
        bend: coefficients (k, 2, n, n) of a random chart.
        centre: coordinates (k, n) of the state in that chart.
    """

    x: Array
    v: Float[Array, "k n"]
    y: Float[Array, "k n"]
    z: Float[Array, "k n"]
    unit: Float[Array, "k n"]
    u: Float[Array, "k m"]
    bend: Float[Array, "k 2 n n"]
    centre: Float[Array, "k n"]


class FlowDeviations(NamedTuple):
    """Relative deviations (k,) from the laws along the observer's flow.

    Attributes:
        plant, error, lyapunov: deviations from the law of that name.
    """

    plant: Array
    error: Array
    lyapunov: Array


class GeometryDeviations(NamedTuple):
    """Relative deviations (k,) from the laws of the geometry.

    Attributes:
        metric, torsion, transport, curvature: deviations of the law of that name.
        sectional: sectional curvatures (k,).
    """

    metric: Array
    torsion: Array
    transport: Array
    curvature: Array
    sectional: Array


def own(given: Any, name: str) -> Any:
    """Look up a field of an observer or a model."""
    return getattr(given, name) if name in getattr(type(given), "__dataclass_fields__", {}) else None


def mechanical(model: Any) -> bool:
    """Test whether this is the model of a mechanical system: one with a configuration space."""
    return own(model, "space") is not None


def exact(observer: AbstractObserver) -> bool:
    """Test whether an observer uses geodesics, and therefore has a budget for them."""
    return own(observer, "budget") is not None


def exchange(observer: Any, model: MechanicalSystem) -> Any:
    """Return the observer with another model."""
    return dataclasses.replace(observer, model=model)


def traced_once(model: MechanicalSystem) -> MechanicalSystem:
    """Return the model with the matrix of a numerical metric traced only once, not once for every derivative."""
    if type(model.space) is not Metric:  # a subclass may have closed forms
        return model
    matrix = jax.jit(model.space.matrix)
    return eqx.tree_at(lambda m: m.space.matrix, model, lambda q: matrix(q))  # not jitted itself: its numbers are fixed


def _both_once(model: MechanicalSystem, observer: Any) -> tuple[MechanicalSystem, Any]:
    """The model, and the observer with its own model, each `traced_once`."""
    own_model = own(observer, "model")
    return traced_once(model), exchange(observer, traced_once(own_model)) if mechanical(own_model) else observer


def configuration(model: MechanicalSystem, s: Vector) -> Array:
    """Return the configuration with these coordinates; on a group, those of the retraction at the origin."""
    return s if model.manifold.commuting else model.manifold.retract(model.manifold.origin(), s)


def bracket(model: MechanicalSystem, x: Array, a: Vector, b: Vector) -> Vector:
    """Compute `[a, b]` by derivatives of the frame, so that the manifold's own formula is tested too."""

    def moved(one, two):
        tangent = model.manifold.tangent(x, one)
        return change(lambda s: model.manifold.tangent(x + s * tangent, two))[1]

    return model.manifold.components(x, moved(a, b) - moved(b, a))


def counterpart(observer: AbstractFlowObserver, model: MechanicalSystem, alpha, beta) -> AbstractFlowObserver:
    """Return the approximate observer `Intrinsic` for an exact one, and the exact `Geodesic` for any other."""
    return Intrinsic(model, alpha, beta) if exact(observer) else Geodesic(model, alpha, beta, NEAR)


def slope(observer: AbstractFlowObserver, x: Array, v: Vector, u: Array, y: Array) -> tuple[Vector, Vector]:
    """Compute the velocity in the frame and v̂' of an estimate."""
    state = observer.init(y)._replace(q=x, v=v)
    rates = observer.flow(jnp.zeros((), v.dtype), state, u, y)
    return rates.q, rates.v


@compiled_quickly
def along_the_flow(
    model: MechanicalSystem,
    observer: AbstractFlowObserver,
    alpha: Scalar,
    beta: Scalar,
    q: Float[Array, "2 2"],
    states: States,
) -> FlowDeviations:
    """Measure deviations at q̂ = q and any velocity: the estimate moves as the plant; law (10); V' for the matrix Q."""
    model, observer = _both_once(model, observer)
    space = model.space

    def one(states: States) -> FlowDeviations:
        x, v, u, xi, delta = states.x, states.v, states.u, states.y, states.z

        t = jnp.zeros(())

        def norm(a):
            return space.norm(x, a)

        def undamped(s):  # without dissipation, which is added to the published law
            at_s, velocity_s = model.manifold.nudged(x, s * xi), v + s * delta
            w, a = slope(observer, at_s, velocity_s, u, x)
            return w, a - friction(model, t, at_s, velocity_s, u)

        (w, a), (w_change, a_change) = change(undamped)
        # The variation ξ is carried by the flow w: [w, ξ] = 0 in space, which in a frame gives this bracket.
        xi_rate = w_change + bracket(model, x, xi, w)

        def transported_by_flow(s):
            """ζ and V of the variation that is transported by the flow."""
            here, xi_now = model.manifold.nudged(x, s * w), xi + s * xi_rate
            # ζ is the covariant derivative of v̂ in the direction ξ, hence the connection.
            zeta = delta + s * a_change + space.connection(here, xi_now, v + s * a)
            gram = space.gram(here, jnp.stack([xi_now, zeta]))
            return zeta, jnp.sum(q * gram) / 2

        (zeta, _), (zeta_rate, lyapunov_rate) = change(transported_by_flow)
        connection_xi, connection_zeta = space.connection(x, w, xi), space.connection(x, w, zeta)
        # Law (10) with ∇ = d/dt + B(w, ·): ∇ξ = ζ − αξ and ∇ζ = −βξ.
        first = xi_rate + connection_xi - (zeta - alpha * xi)
        second = zeta_rate + connection_zeta + beta * xi
        # Relative to the terms that cancel, so that rounding errors are measured in proportion to them.
        lengths = jnp.stack([norm(xi), norm(zeta)])
        sizes = jnp.stack(
            [
                norm(xi_rate) + norm(connection_xi) + lengths[1] + alpha * lengths[0],
                norm(a_change) + norm(zeta_rate - a_change) + norm(connection_zeta) + beta * lengths[0],
            ]
        )
        damping, connection_v = friction(model, t, x, v, u), space.connection(x, v, v)
        plant = acceleration(model, t, x, v, u)
        parts = norm(plant) + norm(a) + norm(damping) + norm(connection_v)
        return FlowDeviations(
            jnp.maximum(norm(w - v) / norm(v), norm(a + damping - plant) / parts),
            jnp.max(jnp.stack([norm(first), norm(second)]) / sizes),
            jnp.abs(lyapunov_rate + lengths @ lengths / 2) / (lengths @ jnp.abs(q) @ sizes),
        )

    return jax.lax.map(one, states)


@compiled_quickly
def of_the_geometry(model: MechanicalSystem, states: States) -> GeometryDeviations:
    """Measure deviations of the connection (metric, symmetric), of transport (isometric) and of
    separating geodesics.
    """
    model = traced_once(model)
    space = model.space

    def one(states: States) -> GeometryDeviations:
        x, a, b, c, e = states.x, states.v, states.y, states.z, states.unit

        def norm(a):
            return space.norm(x, a)

        along_b, along_c = space.connection(x, a, b), space.connection(x, a, c)
        derivative = change(lambda s: space.inner(model.manifold.nudged(x, s * a), b, c))[1]
        metric = jnp.abs(derivative - space.inner(x, along_b, c) - space.inner(x, b, along_c))
        # |b||c| keeps the quotient finite in flat coordinates, where all other terms are 0.
        metric = metric / (jnp.abs(derivative) + norm(along_b) * norm(c) + norm(b) * (norm(along_c) + norm(c)))
        swapped, commutator = space.connection(x, b, a), bracket(model, x, a, b)
        torsion = norm(along_b - swapped - commutator)
        torsion = torsion / (norm(along_b) + norm(swapped) + norm(commutator) + norm(a) * norm(b))

        # Vectors of unit length, so that a badly scaled metric is tested equally in all directions.
        frame = jnp.eye(a.shape[0], dtype=a.dtype)
        frame = frame / jax.vmap(norm)(frame)[:, None]
        b = b / norm(b)

        def in_parallel_frame(t):
            """In the parallel frame: the field that separates neighbouring geodesics, and inner products of the frame.

            Each neighbour starts from its x with the velocity e, transported there to first order.
            """

            def neighbour(s):
                # Velocities that are parallel along the starts, so that the field begins with DJ/dt = 0.
                start, velocity = model.manifold.nudged(x, s * b), e - s * space.connection(x, b, e)
                end = space.transport_along(start, t * velocity, frame, Budget(steps=STEPS))
                return end.q, end.w

            (end, transported), (separation, _) = change(neighbour)
            return transported @ space.lower(end, model.manifold.components(end, separation)), space.gram(
                end, transported
            )

        times = jnp.array([-2 * STEP, -STEP, 0.0, STEP, 2 * STEP, SHORT])
        field, gram = jax.lax.map(in_parallel_frame, times)
        # The second difference of fourth order, on five points.
        second = jnp.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / (12 * STEP**2) @ field[:5]
        jacobi = space.curvature(x, b, e, e)
        deviation = jnp.max(jnp.abs(second + frame @ space.lower(x, jacobi)))
        # |b| = 1 here, so that |e|² − <b, e>² is the squared area that both span.
        area = space.inner(x, e, e) - space.inner(x, b, e) ** 2
        return GeometryDeviations(
            metric,
            torsion,
            jnp.max(jnp.abs(gram[-1] - gram[2])),
            deviation / (1 + norm(jacobi)),
            space.inner(x, b, jacobi) / area,
        )

    return jax.lax.map(one, states)


def _over_pairs(one, states: States, errors: Float[Array, "e"]) -> Float[Array, "e k"]:
    """A function of a state and an error, evaluated for all pairs of both."""
    k, e = states.v.shape[0], errors.shape[0]
    tiled = jax.tree.map(lambda a: jnp.tile(a, (e,) + (1,) * (a.ndim - 1)), states)
    return jax.lax.map(lambda both: one(*both), (tiled, jnp.repeat(errors, k))).reshape(e, k)


def _difference(space: AbstractSpace, gains, x, v, error, one, two) -> Scalar:
    """Distance of two slopes, relative to the correction for the error."""
    (alpha, beta), w, a = gains, one[0] - two[0], one[1] - two[1]
    # α turns the difference of velocities into an acceleration, so that both parts have one unit.
    gap = alpha * space.norm(x, w) + space.norm(x, a + space.connection(x, v, w))
    return gap / ((alpha**2 + beta) * space.norm(x, error))


@compiled_quickly
def between_charts(
    model: MechanicalSystem,
    observer: AbstractFlowObserver,
    gains: tuple[Scalar, Scalar],
    states: States,
    errors: Float[Array, "e"],
) -> Float[Array, "e k"]:
    """Measure relative differences of the observer's slopes, computed in its own chart and in a random cubic one.

    They are compared in the first chart. The second is `q = y + ψ(z) − ψ(centre)` with `ψ(z) = z + A z² + B z³`, with
    powers taken by components.
    """
    model, observer = _both_once(model, observer)
    space = model.space

    def one(states: States, error: Scalar) -> Scalar:
        y, v, u, centre = states.x, states.v, states.u, states.centre

        def cubic(z):
            return z + states.bend[0] @ z**2 + states.bend[1] @ z**3

        def chart(z):
            return y + cubic(z) - cubic(centre)

        rewritten = in_chart(model, chart)
        estimate = centre + error * states.unit
        there = slope(exchange(observer, rewritten), estimate, v, u, centre)
        state, pushed = along(lambda z, w: jnp.stack(along(chart, (z,), (w,))), (estimate, v), there)
        x, velocity = state
        here = slope(observer, x, velocity, u, y)
        return _difference(space, gains, x, velocity, x - y, here, pushed)

    return _over_pairs(one, states, errors)


@compiled_quickly
def between_observers(
    model: MechanicalSystem,
    observer: AbstractFlowObserver,
    gains: tuple[Scalar, Scalar],
    states: States,
    errors: Float[Array, "e"],
) -> Float[Array, "e k"]:
    """Measure relative differences between the slopes of the observer and of its counterpart, approximate or exact."""
    model, observer = _both_once(model, observer)
    space = model.space
    pair = observer, counterpart(observer, model, *gains)

    def one(states: States, error: Scalar) -> Scalar:
        error_vector = error * states.unit
        x = model.manifold.retract(states.x, error_vector)
        one, two = (slope(each, x, states.v, states.u, states.x) for each in pair)
        return _difference(space, gains, x, states.v, error_vector, one, two)

    return _over_pairs(one, states, errors)


def order_of(relative: Float[np.ndarray, "e k"], errors: Float[np.ndarray, "e"], floor: float) -> float | None:
    """Fit the order in the error with which differences vanish."""
    typical = np.sqrt(np.mean(relative**2, axis=1))
    clear = ~(typical < floor)
    if clear.sum() < 2:
        return None
    if not np.isfinite(typical).all():
        return float("nan")
    # One more than the fitted slope, since the differences are relative to the error.
    return float(1 + np.polyfit(np.log(errors[clear]), np.log(typical[clear]), 1)[0])
