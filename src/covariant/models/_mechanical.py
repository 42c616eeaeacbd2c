"""A mechanical system `∇_v v = raise(−dU + force + dissipation)` on any configuration space, as JAX functions.

`Lagrangian` builds one in coordinates, `GroupSystem` one on a Lie group with a left-invariant kinetic energy.

Source: Aghannan & Rouchon 2003, section II; Maithripala, Berg & Dayawansa 2004, section II-D, equations (12)–(16);
Hamel's equations in a frame, Marsden & Ratiu 1999, chapter 13. Dissipation is an addition: every real machine has it.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._functional import Functional
from covariant._integrate import rk4_step
from covariant._typing import Element, MatrixField, Number, Scalar, Vector
from covariant.geometry import AbstractManifold, AbstractSpace, Coordinates, as_space, differential
from covariant.geometry.lie import AbstractGroup, LeftInvariant
from covariant.models._parameters import Parameter, Parametric


class Motion(NamedTuple):
    """Configuration q and velocity v (n,), in the frame of the space: on a group q (N, N) and `q' = q hat(v)`."""

    q: Inexact[Array, "..."]
    v: Float[Array, "*T n"]


class Sought(NamedTuple):
    """What an estimate is for and scored by: what it is, its names and units, and `of(x)`, its values in states x."""

    what: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    of: Callable[[Any], Array]


class MechanicalSystem(Functional):
    """A mechanical system whose configuration is measured.

    - `space`: its configuration space, with the kinetic energy `½ <v, v>` [J] as metric.
    - `potential`: potential energy `q -> ()` [J]; on a group a smooth function of the matrix entries. None for none.
    - `force`: generalised force (a covector in the frame) `(t, q, u) -> (n,)` of the input u (m,); by default u itself.
    - `dissipation`: generalised force that depends on the velocity, `(q, v) -> (n,)`, or `(t, q, v, u) -> (n,)` such as
      that of a rudder or a drag that an input scales. Observers evaluate it at the estimate. Friction opposes the
      motion: viscous friction with coefficient b is `lambda q, v: -b * v`.
    - `coordinates`, `units`: names and units of the entries of q, where they are coordinates.
    - `velocities`, `velocity_units`: names and units of the components of v, where they are not the rates of the
      coordinates.
    - `inputs`: number of inputs m, where it is not n.
    - `parameters`: a `Parameter` for each name, as documentation. Functions made by `Parametric` also hold their
      numbers as leaves of the pytree, so that a model with other numbers needs no new compilation.

    Raises `ValueError` when a function has the wrong shape.
    """

    space: AbstractSpace
    potential: Callable[[Array], Array]
    force: Callable[[Array, Array, Array], Array]
    dissipation: Callable[..., Array]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    velocities: tuple[str, ...] = eqx.field(static=True)
    velocity_units: tuple[str, ...] = eqx.field(static=True)
    inputs: int | None = eqx.field(static=True)
    parameters: dict[str, Parameter]

    def __init__(
        self,
        space: AbstractSpace,
        potential: Callable[[Array], Array] | None = None,
        force: Callable[[Array, Array, Array], Array] | None = None,
        dissipation: Callable[..., Array] | None = None,
        *,
        coordinates: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
        velocities: tuple[str, ...] = (),
        velocity_units: tuple[str, ...] = (),
        inputs: int | None = None,
        parameters: dict[str, Parameter] | None = None,
    ):
        self.space = space
        self.potential = no_potential if potential is None else potential
        self.force = input_itself if force is None else force
        self.dissipation = no_dissipation if dissipation is None else dissipation
        self.coordinates, self.units = tuple(coordinates), tuple(units)
        self.velocities, self.velocity_units = tuple(velocities), tuple(velocity_units)
        self.inputs = inputs
        self.parameters = dict(parameters or {})
        if None not in self.manifold.shape:
            check_model(self)

    @property
    def manifold(self) -> AbstractManifold:
        """The manifold of the configurations."""
        return self.space.manifold

    @property
    def metric(self) -> AbstractSpace:
        """The space, under the name that it has where it is a matrix in coordinates."""
        return self.space

    @property
    def circles(self) -> tuple[int, ...]:
        """Indices of the coordinates that are angles on a full circle [rad]."""
        return self.manifold.circles

    @property
    def logged_units(self) -> dict[str, tuple[str, ...]]:
        """Units of what a log holds of the model, by field of `logs.Columns`, where they are known."""
        return {"q": self.units, "v": self.sought.units, "truth": self.sought.units}

    @property
    def sought(self) -> Sought:
        """What an estimate of the model is for: the velocities; names are empty where these are rates."""
        units = self.velocity_units or tuple(f"{unit}/s" for unit in self.units)
        return Sought("velocity", self.velocities, units, lambda x: self.motion(x).v)

    @property
    def dissipation_is_driven(self) -> bool:
        """Whether the dissipation takes (t, q, v, u), so that it may depend on time and input; otherwise (q, v)."""
        given = self.dissipation
        if isinstance(given, Parametric):
            given = functools.partial(given.function, **given.parameters)
        elif isinstance(given, eqx.Partial):
            given = functools.partial(given.func, *given.args, **given.keywords)
        try:
            inspect.signature(given).bind(None, None)
        except TypeError:
            return True
        except ValueError:  # some built-in functions have no signature
            pass
        return False

    def state(self, motion: Motion) -> Any:
        """The state x of a motion: (q, v) (2n,) in coordinates, the motion itself elsewhere."""
        return jnp.concatenate(motion, axis=-1) if self.manifold.commuting else motion

    def motion(self, x: Any) -> Motion:
        """Configuration and velocity of a state x, or of many states, time first."""
        return Motion(*jnp.split(jnp.asarray(x), 2, axis=-1)) if self.manifold.commuting else x


class Lagrangian(MechanicalSystem):
    """A `MechanicalSystem` in coordinates q (n,), whose positions are measured.

    - `metric`: inertia matrix `q (n,) -> (n, n)`, or a space in coordinates from `covariant.geometry`.
    - `circles`: indices of coordinates that are angles on a full circle [rad]; errors in them are wrapped to ±π.
    - `potential`, `force`, `dissipation`, `coordinates`, `units`, `inputs`, `parameters`: as for `MechanicalSystem`.
      Where the coordinates are named, all functions are checked at once.

    Raises `ValueError` when a function has the wrong shape.
    """

    def __init__(
        self,
        metric: AbstractSpace | MatrixField,
        potential: Callable[[Array], Array] | None = None,
        force: Callable[[Array, Array, Array], Array] | None = None,
        dissipation: Callable[..., Array] | None = None,
        circles: tuple[int, ...] = (),
        *,
        coordinates: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
        inputs: int | None = None,
        parameters: dict[str, Parameter] | None = None,
    ):
        space = as_space(metric, Coordinates(tuple(circles), len(coordinates) or None))
        named = {"coordinates": coordinates, "units": units, "inputs": inputs, "parameters": parameters}
        super().__init__(space, potential, force, dissipation, **named)


class GroupSystem(MechanicalSystem):
    """A `MechanicalSystem` on a Lie group, `g' = g hat(v)`, `I v' = ad*_v I v + force + dissipation` in the body frame.

    - `group`: such as `lie.SO3` or `lie.SE3`.
    - `inertia`: matrix (n, n), or an `AbstractInertia`; on SE(3) v is the twist (v, ω), translation first.
    - `velocities`, `units`: names and units of the components of v.
    - `potential`, `force`, `dissipation`, `inputs`, `parameters`: as for `MechanicalSystem`.

    Raises `ValueError` when a function has the wrong shape.
    """

    def __init__(
        self,
        group: AbstractGroup,
        inertia,
        potential: Callable[[Array], Array] | None = None,
        force: Callable[[Array, Array, Array], Array] | None = None,
        dissipation: Callable[..., Array] | None = None,
        *,
        velocities: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
        inputs: int | None = None,
        parameters: dict[str, Parameter] | None = None,
    ):
        n = group.dimension
        names, units = tuple(velocities) or tuple(f"v{i + 1}" for i in range(n)), tuple(units) or ("",) * n
        if not len(names) == len(units) == n:
            raise ValueError(f"the group has {n} velocities; got {len(names)} names, {len(units)} units")
        super().__init__(
            LeftInvariant(group, inertia),
            potential,
            force,
            dissipation,
            velocities=names,
            velocity_units=units,
            inputs=n if inputs is None else inputs,
            parameters=parameters,
        )

    @property
    def group(self) -> AbstractGroup:
        """The group whose elements are the configurations."""
        return self.space.group  # pyright: ignore[reportAttributeAccessIssue]


def input_itself(t, q, u):
    return u


def no_dissipation(q, v):
    return jnp.zeros_like(v)


def no_potential(q):
    return jnp.zeros((), jnp.finfo(q.dtype).dtype)


def check_model(model: MechanicalSystem, dimension: int | None = None) -> None:
    """Raise `ValueError` unless every function of the model has the shape that its configurations need.

    `dimension`: the number of coordinates, for a model that does not name them.
    """
    known = dimension is None or None not in model.manifold.shape
    q = jax.eval_shape(model.manifold.origin) if known else jax.ShapeDtypeStruct((dimension,), jnp.float64)
    if any(not 0 <= i < q.shape[0] for i in model.circles):
        count = q.shape[0]
        raise ValueError(f"circles {model.circles} must be indices of the {count} coordinates, 0 to {count - 1}")
    v = jax.eval_shape(model.manifold.zero, q)
    n = v.shape[0]
    u = jax.ShapeDtypeStruct((input_count(model, n),), jnp.float64)
    t = jax.ShapeDtypeStruct((), jnp.float64)
    whom = f"{n} coordinates" if model.manifold.commuting else f"configurations {q.shape} of {n} dimensions"
    functions = (
        ("metric", getattr(model.space, "matrix", model.space), (q,), (n, n)),
        ("potential", model.potential, (q,), ()),
        ("force", model.force, (t, q, u), (n,)),
        ("dissipation", functools.partial(resistance, model), (t, q, v, u), (n,)),
    )
    check_shapes(functions, f"{whom} and {u.shape[0]} inputs", whom)


def check_shapes(functions, given: str, whom: str) -> None:
    """Raise `ValueError` for the first (name, function, arguments, shape) whose function returns another shape."""
    for name, function, arguments, wanted in functions:
        try:
            shape = jax.eval_shape(function, *arguments).shape
        except (TypeError, ValueError, IndexError, AttributeError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{name} cannot be evaluated with {given}: {reason}") from error
        if shape != wanted:
            raise ValueError(f"{name} must return shape {wanted} for {whom}; it returned {shape}")


def applied_force(model: MechanicalSystem, t: Scalar, q: Array, u: Float[Array, "m"]) -> Vector:
    """`−∂U + force`: the generalised force on the system apart from dissipation, in the frame.

    Raises `ValueError` for a force of another shape, such as one input that would act on all coordinates.
    """
    force, slope = model.force(t, q, u), differential(model.manifold, model.potential, q)
    if force.shape != slope.shape:
        raise ValueError(f"force must return shape {slope.shape}; with {u.shape[0]} inputs it returned {force.shape}")
    return force - slope


def source(model: MechanicalSystem, t: Scalar, q: Array, u: Float[Array, "m"]) -> Vector:
    """`S(q, t) = raise(−∂U + force)`, the acceleration of the system at rest without friction."""
    return model.space.raise_(q, applied_force(model, t, q, u))


def resistance(model: MechanicalSystem, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"]) -> Array:
    """The dissipation, a generalised force in the frame, for either signature of the model's function."""
    return model.dissipation(t, q, v, u) if model.dissipation_is_driven else model.dissipation(q, v)


def friction(model: MechanicalSystem, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"]) -> Vector:
    """`raise(dissipation)`: the acceleration due to dissipation."""
    return model.space.raise_(q, resistance(model, t, q, v, u))


def input_count(model: Any, n: int) -> int:
    """Number of inputs m of a model; where it does not state one, its number n of velocities."""
    return n if model.inputs is None else model.inputs


def acceleration(model: MechanicalSystem, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"]) -> Vector:
    """Forward dynamics `v' = raise(−∂U + force + dissipation − M B(v, v))` (Hamel)."""
    covector = applied_force(model, t, q, u) + resistance(model, t, q, v, u)
    return model.space.raise_(q, covector - model.space.connection_force(q, v, v))


def energy(model: MechanicalSystem, q: Array, v: Vector) -> Scalar:
    """Kinetic plus potential energy [J]."""
    return model.space.inner(q, v, v) / 2 + model.potential(q)


def spatial_momentum(system: MechanicalSystem, g: Element, v: Vector) -> Vector:
    """`Ad*_{g⁻¹} I v` on a group: the momentum in the space frame, constant where no force acts."""
    group = _group_of(system)
    return group.coadjoint_action(group.inverse(g), system.space.lower(g, v))


def body_velocity(system: MechanicalSystem, g: Element, momentum: Vector) -> Vector:
    """The body velocity v whose momentum in the space frame is `momentum` at g, on a group."""
    return system.space.raise_(g, _group_of(system).coadjoint_action(g, momentum))


def _group_of(system: MechanicalSystem) -> AbstractGroup:
    if not isinstance(system.manifold, AbstractGroup):
        raise ValueError(f"the momentum in space is that of a system on a group; this one is on {system.manifold}")
    return system.manifold


InputLaw = Callable[[Scalar, Any], Array]
"""Input `(t, x) -> u (m,)` of the state x."""


def advance(
    system: MechanicalSystem,
    t: Number,
    motion: Motion,
    u: InputLaw | Float[Array, "m"],
    dt: Number,
    steps,
    rule=rk4_step,
) -> Motion:
    """Integrate the system over dt [s] in equal steps, under an input u (m,) held constant, or a function `(t, x) -> u`
    of the state x.

    `rule` is a one-step method `(flow, t, x, dt) -> x` of `covariant._integrate`.
    """
    advanced = _in_coordinates if system.manifold.commuting else _in_frame
    return advanced(system, t, motion, u if callable(u) else lambda s, x: u, dt, steps, rule)


def _in_coordinates(system: MechanicalSystem, t: Number, motion: Motion, u: InputLaw, dt, steps, rule) -> Motion:
    @jax.jit  # traced once, not at each slope of the rule
    def flow(s, now):
        return Motion(now.v, acceleration(system, s, now.q, now.v, u(s, system.state(now))))

    h = dt / jnp.asarray(steps, motion.v.dtype)
    return jax.lax.fori_loop(0, steps, lambda i, now: rule(flow, t + jnp.asarray(i, h.dtype) * h, now, h), motion)


def _in_frame(system: MechanicalSystem, t: Number, motion: Motion, u: InputLaw, dt, steps, rule) -> Motion:
    """Integrate on the manifold, where the configuration always stays.

    The other unknown of each step is the momentum in the frame at the start of the step. Where no force acts on it, as
    on a floating base, it is constant to rounding whatever the step."""
    h = dt / jnp.asarray(steps, motion.v.dtype)

    def step(i, now):
        begin = t + jnp.asarray(i, h.dtype) * h
        start = MomentumChart(system, now[0])

        @jax.jit  # traced once, not at each slope of the rule
        def flow(s, x):
            return start.flow(s, x, u)[0]

        s, momentum = rule(flow, begin, (jnp.zeros_like(now[1]), now[1]), h)
        return start.end(s, momentum)

    q, momentum = jax.lax.fori_loop(0, steps, step, (motion.q, system.space.lower(*motion)))
    return Motion(q, system.space.raise_(q, momentum))


class MomentumChart(NamedTuple):
    """The equations of motion around a configuration: coordinates s of the retraction, and the momentum in the frame of
    the centre.

    With `μ = M v`, Hamel's equations are `μ' = ad*_v μ + ½∂<v, v> + force`; in the frame at the centre the first term
    vanishes.
    """

    system: MechanicalSystem
    centre: Inexact[Array, "..."]

    def motion(self, s: Vector, momentum: Vector) -> Motion:
        """Configuration and velocity at the coordinates s with the given momentum."""
        q = self.system.manifold.retract(self.centre, s)
        return Motion(q, self.system.space.raise_(q, self.system.manifold.carried_momentum(self.centre, s, momentum)))

    def flow(self, t: Scalar, now: tuple[Vector, Vector], u: InputLaw) -> tuple[tuple[Vector, Vector], Motion]:
        """Derivatives of s and of the momentum, and the motion they belong to."""
        system, (s, momentum) = self.system, now
        q, v = x = self.motion(s, momentum)
        inputs = u(t, x)
        force = applied_force(system, t, q, inputs) + resistance(system, t, q, v, inputs)
        force = force + system.space.kinetic_force(q, v)
        rate = system.manifold.local_rate(self.centre, s, v)
        return (rate, system.manifold.carried_momentum(self.centre, -s, force)), x

    def end(self, s: Vector, momentum: Vector) -> tuple[Array, Vector]:
        """The configuration at s, and the momentum in its frame: the start of the next chart."""
        manifold = self.system.manifold
        return manifold.retract(self.centre, s), manifold.carried_momentum(self.centre, s, momentum)
