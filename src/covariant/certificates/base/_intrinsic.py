"""Describes an intrinsic observer as the system of a proof: flow and metric as functions of variables in a box.

The variables are the estimate, the error of its position, and the force on the system. They are sufficient: the source
`S = g⁻¹ f` at the measured position is a known function of the force f, whatever the input, potential and time that
cause it. On a group, symmetry makes the estimated configuration irrelevant too; models whose friction breaks this
symmetry are refused.

The friction of a joint may be replaced by two further variables, its force and its slope. The proof then covers every
friction within these bounds, so that no box has to resolve how steep it is near rest.

Where friction depends on time or on inputs, as the force of a rudder does, these are the last variables. The inequality
has no derivatives by them: plant and observer read the same signals, which may jump at any time within their bounds.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._domains import FINITE, check_numbers
from covariant._typing import Vector
from covariant.certificates.base._contraction import StateMetric
from covariant.certificates.base._error_system import ErrorSystem, Point, entries_read
from covariant.certificates.base._properties import need_known, need_symmetry
from covariant.certificates.base._tangent_metric import TwoByTwo, tangent_metric
from covariant.geometry.lie import AbstractGroup
from covariant.models import MechanicalSystem, input_count, resistance
from covariant.observers import Geodesic, Intrinsic, second_order
from scalargraph import expand, lower
from scalargraph.errors import InputError

Intrinsics = Intrinsic | Geodesic
OBSERVERS: dict[str, dict[str, Any]] = {
    "intrinsic": {"order": (1, 2), "coefficients": ("measured", "estimated"), "curvature": bool},
    "geodesic": {"curvature": bool},
}
"""The fields of each kind of observer besides the gains, with their possible values."""
OBSERVER_KINDS = {"intrinsic": Intrinsic, "geodesic": Geodesic}
"""The observers for which certificates exist, by their name in a file."""


@check_numbers
def error_system(observer: Intrinsics, q: Annotated[TwoByTwo, FINITE], joint_friction: bool = False) -> ErrorSystem:
    """Describe an intrinsic observer on any region, and a metric on states, for `contraction`, `prove` and `falsify`.

    Args:
        observer: an `Intrinsic` or a `Geodesic` (in coordinates), but no subclass.
        q: matrix Q (2, 2) that turns the metric of the model into the metric on states, as from `lyapunov`.
        joint_friction: whether friction and its slopes are variables too, independent of the velocity. Friction must
            then act separately in each joint, by its own velocity, in coordinates.

    Returns:
        Flow and metric as functions of estimate, error and force, and with `joint_friction` of friction and its slopes,
        or of time and those inputs that the friction depends on.

    Raises:
        TypeError: another kind of observer.
        ValueError: a space or a friction that is not covered.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> from covariant.certificates import error_system
        >>> system = error_system(observers.Intrinsic(models.oscillator(), 2.0, 2.0), np.eye(2))
        >>> system.names
        ('q', 'v_q', 'e_q', 'f_q')
    """
    # The flow is formulated anew for the proof, from the equations of these two classes; a subclass may run another.
    if type(observer) not in (Intrinsic, Geodesic):
        raise TypeError(
            f"certificates are about the flows of Intrinsic and Geodesic themselves; got {type(observer).__name__}, "
            "whose flow may be another one"
        )
    need_known(observer.model)
    space = observer.model.space
    if space.manifold.commuting:
        return _in_coordinates(observer, q, joint_friction)
    if joint_friction:
        raise InputError("friction as variables of its own needs coordinates")
    if isinstance(space.manifold, AbstractGroup) and isinstance(observer, Intrinsic):
        return _in_the_body(observer, q)
    raise InputError(
        "a region is a box of coordinates, or for Intrinsic of velocities alone on a group; "
        f"{type(observer).__name__} on {space.manifold} is not covered"
    )


def first_order(observer: Intrinsics) -> Intrinsic:
    """Return observer (5) for the exact one (2): that of the same model, gains and curvature; any other unchanged."""
    if not isinstance(observer, Geodesic):
        return observer
    if not observer.model.manifold.commuting:
        raise InputError("the exact observer is covered in coordinates, where its geodesics stay in a box")
    return Intrinsic(observer.model, observer.alpha, observer.beta, curvature=observer.curvature)


def configuration_shape(model: MechanicalSystem, n: int) -> tuple[int, ...]:
    """Return the shape of a configuration: (n,) for coordinates, or the shape of a matrix of the group."""
    return (n,) if model.manifold.commuting else jax.eval_shape(model.manifold.origin).shape


def _in_coordinates(observer: Intrinsics, q: TwoByTwo, joint_friction: bool) -> ErrorSystem:
    model = observer.model
    n = dimension(model)
    if joint_friction:
        need_joint_friction(model)
    prefixes = ("", "v_", "e_", "f_", "r_", "d_")[: 6 if joint_friction else 4]
    driven = driven_by(model)
    metric = tangent_metric(model.space, q)

    def at(z):
        place, velocity, error, force, *joints, signals = jnp.split(z, [k * n for k in range(1, len(prefixes) + 1)])
        measured = place - error

        def friction(place, v):
            if not joint_friction:
                return friction_of(model, place, v, driven, signals)
            # The value of friction at this velocity, with any slope within its bounds.
            value, drag = joints
            return value - drag * (v - velocity)

        # Force and potential are left out, since the force is a variable of the box and enters as the input.
        bare = with_model(observer, MechanicalSystem(model.space, None, None, friction))

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
            # The error is estimate minus measurement, hence the minus sign.
            lambda: -jnp.eye(n, dtype=z.dtype),
        )

    names = model.coordinates
    units = model.units or ("",) * n
    rates = tuple(f"{unit}/s" if unit else "" for unit in units)
    signal_names, signal_units = signals_of(model, driven)
    return ErrorSystem(
        (*(f"{prefix}{name}" for prefix in prefixes for name in names), *signal_names),
        (*units, *rates, *units, *("",) * (n * (len(prefixes) - 3)), *signal_units),
        at,
        driven=driven,
    )


def _in_the_body(observer: Intrinsic, q: TwoByTwo) -> ErrorSystem:
    model, space, manifold = observer.model, observer.model.space, observer.model.manifold
    need_symmetry(model)
    origin = manifold.origin()
    inertia = np.array(space(origin))
    n, driven = len(inertia), driven_by(model)

    def each(linear, dtype):
        return jax.vmap(linear, out_axes=1)(jnp.eye(n, dtype=dtype))

    # The chart around an estimate is the retraction, with coordinates θ; everything is evaluated at θ = 0.
    def frames(x, sign):
        theta, v = jnp.split(x, 2)
        body = each(functools.partial(manifold.frame_velocity, origin, theta), x.dtype)
        turn = each(lambda e: space.connection(origin, e, v), x.dtype)
        # [[E, 0], [ΓE, I]]⁻¹ = [[E⁻¹, 0], [−Γ, I]]; E maps the rate of θ to the body velocity.
        lower = turn @ body if sign > 0 else -turn
        upper = body if sign > 0 else each(functools.partial(manifold.local_rate, origin, theta), x.dtype)
        return jnp.block([[upper, jnp.zeros((n, n), x.dtype)], [lower, jnp.eye(n, dtype=x.dtype)]])

    def gram(t, x):
        return jnp.asarray(np.kron(q / 2, inertia), x.dtype)

    length = StateMetric(lambda t, x: frames(x, 1), lambda t, x: frames(x, -1), gram)

    def at(z):
        velocity, error, force, signals = jnp.split(z, [n, 2 * n, 3 * n])

        def flow(t, x):
            theta, v = jnp.split(x, 2)
            # log(exp(−θ) exp(−e)) to first order in θ, without computing a logarithm, which branches on matrix
            # entries. It is an identity for errors whose logarithm is unique.
            correction = -error - manifold.local_rate(origin, error, theta)
            at = manifold.origin(z.dtype)
            xi = -correction if observer.order == 1 else second_order(space, at, -correction)
            source = space.raise_(at, force)
            resistance_vector = space.raise_(at, friction_of(model, at, v, driven, signals))
            drive = observer.bend(at, source - space.connection(at, xi, source), xi, v)
            w, v_dot = observer.rates(at, v, xi, drive + resistance_vector)
            return jnp.concatenate([manifold.local_rate(origin, theta, w), v_dot])

        x = jnp.concatenate([jnp.zeros(n, z.dtype), velocity])

        def error_jacobian():
            rates = each(functools.partial(manifold.local_rate, origin, error), z.dtype)
            rows = jnp.concatenate([rates, jnp.zeros((n, n), z.dtype)], axis=1)
            return jnp.concatenate([rows, length.frame(jnp.zeros((), z.dtype), x)[n:]])

        def noise_jacobian():
            return -each(functools.partial(manifold.local_rate, origin, -error), z.dtype)

        return Point(flow, length, x, error_jacobian, noise_jacobian)

    names, units = model.velocities, model.velocity_units
    position_units = tuple(unit.removesuffix("/s") for unit in units)
    signal_names, signal_units = signals_of(model, driven)
    return ErrorSystem(
        (*names, *(f"e_{k}" for k in names), *(f"f_{k}" for k in names), *signal_names),
        (*units, *position_units, *("",) * n, *signal_units),
        at,
        driven=driven,
    )


def with_model(observer: Any, model: MechanicalSystem) -> Any:
    """Return an observer of the same kind, with the same fields, for another model."""
    fields = {name: getattr(observer, name) for name in type(observer).__dataclass_fields__}
    return type(observer)(**(fields | {"model": model}))


def dimension(model: MechanicalSystem) -> int:
    """Return the number of coordinates of a model, which must have names."""
    if not model.coordinates:
        raise InputError("the model must name its coordinates, so that a region can; give Lagrangian(coordinates=...)")
    return len(model.coordinates)


def friction_of(
    model: MechanicalSystem, q: Array, v: Vector, driven: tuple[int, ...] = (), signals: Sequence[Any] | Vector = ()
) -> Vector:
    """Evaluate the dissipation (n,), of which `driven_by` are the places of the given signals."""
    known, zero = dict(zip(driven, signals, strict=True)), jnp.zeros((), v.dtype)
    t, *u = (known.get(k, zero) for k in range(1 + input_count(model, v.shape[0])))
    return resistance(model, t, q, v, jnp.stack(u) if u else jnp.zeros(0, v.dtype))


def driven_by(model: MechanicalSystem) -> tuple[int, ...]:
    """Return the places among (time, inputs) of the signals that the dissipation depends on."""
    if not model.dissipation_is_driven:
        return ()
    q = any_configuration(model)
    v = model.manifold.zero(q)
    u = jnp.zeros(input_count(model, v.size))
    read = entries_read(functools.partial(resistance, model), jnp.zeros(()), q, v, u)
    # Inputs come after time, configuration and velocity.
    return tuple(k for k in range(1 + u.size) if (k + (q.size + v.size) * (k > 0)) in read)


def signals_of(model: MechanicalSystem, places: Sequence[int] | None = None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names and units of time and inputs, or of some of them by their places."""
    servos = getattr(model.force, "servos", None)
    named = model if servos is None else servos
    count = input_count(model, len(model.coordinates or model.velocities))
    names = ("time", *(named.input_names or (f"u{i + 1}" for i in range(count))))
    units = ("s", *(named.input_units or ("",) * count))
    chosen = range(1 + count) if places is None else places
    return tuple(names[k] for k in chosen), tuple(units[k] for k in chosen)


def need_steady_friction(model: MechanicalSystem) -> None:
    """Check that the dissipation depends on neither time nor input, where these are not variables of a region."""
    servos, dependences = getattr(model.force, "servos", None), signals_of(model, driven_by(model))[0]
    if dependences:
        remedy = (
            ""
            if servos is None
            else "; a servo with a `limit`, a `switch` or friction by `load` has another: leave these out of [servo], "
            "and the proof is about the machine while it stays within its limits and switched on"
        )
        raise InputError(
            f"the dissipation of this model depends on {', '.join(dependences)}; a proof covers this for Intrinsic and "
            f"Geodesic in continuous time alone{remedy}"
        )


def any_configuration(model: MechanicalSystem) -> Array:
    """Return a configuration, for quantities that do not depend on it."""
    return jnp.zeros(dimension(model)) if model.manifold.commuting else model.manifold.origin()


def need_joint_friction(model: MechanicalSystem) -> None:
    """Check that friction acts separately in each joint, or about each axis of a body, by its own velocity."""
    need_steady_friction(model)
    n = dimension(model) if model.manifold.commuting else len(model.velocities)
    q = any_configuration(model)
    friction = functools.partial(friction_of, model)
    if any(i < q.size for i in entries_read(friction, q, jnp.zeros(n))):
        covered = "covered here is friction of the velocity alone"
        raise InputError(f"the friction of this model depends on the position; {covered}")
    expansion = expand(lower(functools.partial(friction, q), jnp.zeros(n)), range(n), 1)
    slopes = expansion.nodes()[1].reshape(n, n)
    if any(not expansion.graph.is_zero(int(slopes[i, j])) for i in range(n) for j in range(n) if i != j):
        raise InputError(
            "the friction of this model couples coordinates; covered is friction that acts on each of them by its own "
            "velocity"
        )


def check_unique(observer: Intrinsics, error: Float[np.ndarray, "n"]) -> None:
    """Check that the shortest path to the measurement is unique for errors up to a bound.

    Errors must be below half a turn: in each circle, and in each rotation at the farthest corner of the box.
    """
    model = observer.model
    if model.manifold.rotations is None:
        raise InputError(
            f"how far the logarithm of {type(model.manifold).__name__} is unique is not known; no proof there"
        )
    for turn in model.manifold.rotations:
        # The factors cover the rounding of the norm and of π, so that the comparison is on the safe side.
        farthest = math.sqrt(math.fsum(float(error[i]) ** 2 for i in turn)) * (1 + 1e-12)
        if not farthest < math.pi * (1 - 1e-12):
            names = model.coordinates or model.velocities
            raise InputError(
                f"the error of {', '.join(names[i] for i in turn)} must be below π, at the farthest corner of its box; "
                f"it is up to {farthest:g} there"
            )


def observer_document(observer: Intrinsics) -> dict[str, Any]:
    """Convert an observer without its model to data."""
    kind = next(name for name, cls in OBSERVER_KINDS.items() if type(observer) is cls)
    content: dict[str, Any] = {"kind": kind, "frame": frame_of(observer.model)}
    content |= {"alpha": float(observer.alpha), "beta": float(observer.beta)}
    for field in dataclasses.fields(observer):
        value = getattr(observer, field.name)
        if field.name in OBSERVERS[kind]:
            content[field.name] = value
        elif field.name not in ("model", "alpha", "beta", "substeps", "budget") and value != field.default:
            raise InputError(f"an observer with {field.name} = {value!r} cannot be written into a certificate")
    return content


def frame_of(model: MechanicalSystem) -> str:
    """Return the frame of the vectors of a model, as named in a certificate: "coordinates" or "body"."""
    return "coordinates" if model.manifold.commuting else "body"
