"""Defines mechanical systems `∇_v v = raise(−dU + force + dissipation)` on any configuration space, as JAX functions.

`Lagrangian` builds one in coordinates, `GroupSystem` one on a Lie group with a left-invariant kinetic energy.

Source: Aghannan & Rouchon 2003, section II; Maithripala, Berg & Dayawansa 2004, section II-D, equations (12)–(16);
Hamel's equations in a frame, Marsden & Ratiu 1999, chapter 13. Dissipation is added to the sources' equations, since
every real machine has it.
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
from covariant._typing import MatrixField, Number, Scalar, Vector
from covariant.geometry import AbstractManifold, AbstractSpace, Coordinates, Leaf, as_space, differential
from covariant.geometry.lie import AbstractGroup, LeftInvariant
from covariant.models._parameters import Inputs, Parameter, Parametric, name_inputs
from scalargraph.errors import InputError


class Motion(NamedTuple):
    """Configuration and velocity of a mechanical system.

    It is the state of a system on a group, whose configuration is a matrix and cannot share a vector with the velocity.
    In coordinates, a state is the vector (q, v) instead; `model.state(motion)` converts to it.

    Attributes:
        q: Configuration: coordinates (n,) [their units], or on a group the matrix (N, N).
        v: Velocity (n,), in the frame of the configuration space; on a group `q' = q hat(v)`.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> motion = models.Motion(q=jnp.array([0.1]), v=jnp.array([2.0]))
        >>> models.oscillator().state(motion).tolist()
        [0.1, 2.0]
    """

    q: Inexact[Array, "..."]
    v: Float[Array, "*T n"]


class Sought(NamedTuple):
    """The quantity that an observer of a model estimates and is scored by.

    Attributes:
        what: What the quantity is: "velocity" or "state".
        names: Names of its entries; empty if they are the rates of the coordinates.
        units: Unit of each entry.
        of: `of(x)`: the values of the quantity in the state x, or in many states, with time first.

    Example:
        >>> from covariant import models
        >>> models.oscillator().sought.units
        ('m/s',)
    """

    what: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    of: Callable[[Any], Array]


class MechanicalSystem(Functional):
    """A mechanical system whose configuration is measured.

    The generalised forces are covectors in the frame of the configuration space. Use `Lagrangian` for a system in
    coordinates and `GroupSystem` for one on a Lie group.

    Attributes:
        space: Configuration space, with the kinetic energy `½ <v, v>` [J] as metric.
        potential: Potential energy `q -> ()` [J]; on a group a smooth function of the matrix entries. Zero by default.
        force: Generalised force `(t, q, u) -> (n,)` of the input u (m,); by default u itself.
        dissipation: Generalised force that depends on the velocity, `(q, v) -> (n,)`, or `(t, q, v, u) -> (n,)`, for
            example for a rudder or a drag that an input scales. Observers evaluate it at the estimate. Friction opposes
            the motion: viscous friction with coefficient b is `lambda q, v: -b * v`. Zero by default.
        coordinates: Names of the entries of q, if they are coordinates.
        units: Units of the entries of q, if they are coordinates.
        velocities: Names of the components of v, if they are not the rates of the coordinates.
        velocity_units: Units of the components of v, if they are not the rates of the coordinates.
        inputs: Number of inputs m, if it differs from n; or the unit of each input by its name.
        input_names, input_units: Names and units of the inputs, as far as they are given.
        feet: Positions `q -> (k, d)` [m] of k feet or hands that touch the ground at known times and then stay there.
            The last k inputs are their contacts: 1 for a foot on the ground, 0 for one in the air. None by default.
        parameters: A `Parameter` for each name, as documentation. Functions built by `Parametric` also store these
            numbers as leaves of the pytree, so that a model with other numbers needs no new compilation.

    Raises:
        ValueError: A function returns the wrong shape.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.geometry import Coordinates, Metric
        >>> space = Metric(lambda q: 2.0 * jnp.eye(1), manifold=Coordinates((), 1))  # a mass of 2 kg
        >>> cart = models.MechanicalSystem(space, coordinates=("x",), units=("m",))
        >>> models.energy(cart, jnp.zeros(1), jnp.array([3.0])).item()
        9.0
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
    input_names: tuple[str, ...] = eqx.field(static=True)
    input_units: tuple[str, ...] = eqx.field(static=True)
    feet: Callable[[Array], Array] | None
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
        inputs: Inputs = None,
        feet: Callable[[Array], Array] | None = None,
        parameters: dict[str, Parameter] | None = None,
    ):
        self.space = space
        self.potential = no_potential if potential is None else potential
        self.force = input_itself if force is None else force
        self.dissipation = no_dissipation if dissipation is None else dissipation
        self.coordinates, self.units = tuple(coordinates), tuple(units)
        self.velocities, self.velocity_units = tuple(velocities), tuple(velocity_units)
        self.inputs, self.input_names, self.input_units = name_inputs(inputs)
        self.feet = feet
        self.parameters = dict(parameters or {})
        if None not in self.manifold.shape:
            check_model(self)

    def __repr__(self) -> str:
        names = self.coordinates or self.velocities or (type(self.manifold).__name__,)
        units = self.units if self.coordinates else self.velocity_units if self.velocities else ()
        listed = (f"{name} [{unit}]" for name, unit in zip(names, units or [""] * len(names), strict=False))
        numbers = f"; {len(self.parameters)} parameters: {', '.join(self.parameters)}" if self.parameters else ""
        return f"<{type(self).__name__}: {', '.join(listed).replace(' []', '')}{numbers}>"

    @property
    def manifold(self) -> AbstractManifold:
        """The manifold of the configurations."""
        return self.space.manifold

    @property
    def metric(self) -> AbstractSpace:
        """The configuration space, under the name used for an inertia matrix in coordinates."""
        return self.space

    @property
    def circles(self) -> tuple[int, ...]:
        """Indices of the coordinates that are angles on a full circle [rad]."""
        return self.manifold.circles

    @property
    def logged_units(self) -> dict[str, tuple[str, ...]]:
        """Known units of the logged quantities.

        Returns:
            Units of each entry, by field of `logs.Columns`: positions `q`, velocities `v`, the reference `truth`, and
            inputs `u` if they are commands or have units.
        """
        units = {"q": self.units, "v": self.sought.units, "truth": self.sought.units}
        servos = getattr(self.force, "servos", None)
        return units | {"u": self.input_units if servos is None else servos.input_units}

    @property
    def sought(self) -> Sought:
        """The quantity that an observer of the model estimates: the velocity.

        Returns:
            Its names, units and values; the names are empty if the velocities are the rates of the coordinates.
        """
        units = self.velocity_units or tuple(f"{unit}/s" for unit in self.units)
        return Sought("velocity", self.velocities, units, lambda x: self.motion(x).v)

    @property
    def dissipation_is_driven(self) -> bool:
        """Whether the dissipation has the signature (t, q, v, u), and so may depend on time and input.

        Returns:
            True for (t, q, v, u), False for (q, v), decided by the number of arguments that the function takes.
        """
        function = self.dissipation
        if isinstance(function, Parametric):
            function = functools.partial(function.function, **function.parameters)
        elif isinstance(function, eqx.Partial):
            function = functools.partial(function.func, *function.args, **function.keywords)
        try:
            # A call is tried instead of counting arguments, which may have defaults, be bound, or be in *args.
            inspect.signature(function).bind(None, None)
        except TypeError:
            return True
        except ValueError:  # some built-in functions have no signature
            pass
        return False

    def loop_load(self, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"]) -> Float[Array, "c"]:
        """Forces in the joints that close the loops of a machine, on a `covariant.geometry.Leaf`.

        Args:
            t: Time [s].
            q: Configuration.
            v: Velocity (n,).
            u: Input (m,).

        Returns:
            Force (c,) per unit of each row of the constraint [N for a distance, N m for an angle]. For coinciding
            points of two links it acts on the second link, in the frame of the first. Empty without loops.

        Example:
            >>> import jax.numpy as jnp
            >>> from covariant import models
            >>> models.oscillator().loop_load(jnp.zeros(()), jnp.zeros(1), jnp.zeros(1), jnp.zeros(1)).shape
            (0,)
        """
        if not isinstance(self.space, Leaf):
            return jnp.zeros(0, v.dtype)
        return self.space.load(q, v, applied_force(self, t, q, u) + resistance(self, t, q, v, u))

    def state(self, motion: Motion) -> Any:
        """Convert a motion to a state x.

        Args:
            motion: Configuration and velocity; leading axes, such as time, are allowed.

        Returns:
            (q, v) (2n,) for a system in coordinates, otherwise the motion itself.
        """
        return jnp.concatenate(motion, axis=-1) if self.manifold.commuting else motion

    def motion(self, x: Any) -> Motion:
        """Convert a state x, or many states, time first, to a motion.

        Args:
            x: (q, v) (..., 2n) for a system in coordinates, a `Motion` elsewhere.

        Returns:
            Configuration and velocity.
        """
        return Motion(*jnp.split(jnp.asarray(x), 2, axis=-1)) if self.manifold.commuting else x


class Lagrangian(MechanicalSystem):
    """A mechanical system in coordinates q (n,), whose positions are measured.

    If the coordinates are named, all functions are checked at once.
    Use it for a machine with joints, such as a pendulum, a crane or an arm, whose equations follow from inertia and
    potential. The equations of motion are derived from these by automatic differentiation. Name the coordinates, so
    that mistakes in shapes are found early. Use `GroupSystem` for a body that turns freely, `models.robots.load` for a
    robot file, and `StateSpace` for a system that is not mechanical.

    Args:
        metric: Inertia matrix `q (n,) -> (n, n)`, or a space in coordinates from `covariant.geometry`.
        potential: Potential energy `q -> ()` [J]; zero by default.
        force: Generalised force `(t, q, u) -> (n,)` of the input u (m,); by default u itself.
        dissipation: Velocity-dependent generalised force `(q, v) -> (n,)` or `(t, q, v, u) -> (n,)`; zero by default.
        circles: Indices of coordinates that are angles on a full circle [rad]; errors in them are wrapped to ±π.
        coordinates: Names of the entries of q.
        units: Units of the entries of q.
        inputs: Number of inputs m, if it differs from n, or the unit of each by its name.
        feet: Positions `q -> (k, d)` [m] of feet, as for `MechanicalSystem`.
        parameters: A `Parameter` for each name, as for `MechanicalSystem`.

    Raises:
        ValueError: A function returns the wrong shape, or `circles` are not indices of coordinates.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> pendulum = models.Lagrangian(
        ...     lambda q: jnp.eye(1),  # m l² = 1 kg m²
        ...     lambda q: -9.81 * jnp.cos(q[0]),  # m g l = 9.81 N m, hanging at 0
        ...     circles=(0,),
        ...     coordinates=("angle",),
        ...     units=("rad",),
        ... )
        >>> level = jnp.array([jnp.pi / 2])
        >>> models.acceleration(pendulum, 0.0, level, jnp.zeros(1), jnp.zeros(1)).round(2).tolist()
        [-9.81]
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
        inputs: Inputs = None,
        feet: Callable[[Array], Array] | None = None,
        parameters: dict[str, Parameter] | None = None,
    ):
        space = as_space(metric, Coordinates(tuple(circles), len(coordinates) or None))
        named = {"coordinates": coordinates, "units": units, "inputs": inputs, "feet": feet, "parameters": parameters}
        super().__init__(space, potential, force, dissipation, **named)


class GroupSystem(MechanicalSystem):
    """A mechanical system on a Lie group, `g' = g hat(v)`, `I v' = ad*_v I v + force + dissipation` in the body frame.

    Use it for a body that turns freely, such as a satellite, an aircraft or a vehicle under water. Unlike Euler angles,
    it has no singular attitude. The velocity is in the body frame, and the input is by default a force or torque in
    that frame. Use `Lagrangian` for machines whose joints have coordinates.

    Args:
        group: Lie group of the configurations, such as `lie.SO3` or `lie.SE3`.
        inertia: Matrix (n, n) or an `AbstractInertia`; on SE(3) v is the twist (v, ω), translation first.
        potential: Potential energy `g -> ()` [J], a smooth function of the matrix entries; zero by default.
        force: Generalised force `(t, g, u) -> (n,)` in the body frame; by default the input u itself.
        dissipation: Velocity-dependent generalised force `(g, v) -> (n,)` or `(t, g, v, u) -> (n,)`; zero by default.
        velocities: Names of the components of v; v1, v2, … by default.
        units: Units of the components of v.
        inputs: Number of inputs m, or the unit of each by its name; n by default.
        parameters: A `Parameter` for each name, as for `MechanicalSystem`.

    Raises:
        ValueError: A function returns the wrong shape, or the number of names or units differs from n.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.geometry import lie
        >>> body = models.GroupSystem(lie.SO3, jnp.diag(jnp.array([1.0, 2.0, 3.0])))
        >>> models.acceleration(body, 0.0, jnp.eye(3), jnp.ones(3), jnp.zeros(3)).round(3).tolist()
        [-1.0, 1.0, -0.333]
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
        inputs: Inputs = None,
        parameters: dict[str, Parameter] | None = None,
    ):
        n = group.dimension
        names, units = tuple(velocities) or tuple(f"v{i + 1}" for i in range(n)), tuple(units) or ("",) * n
        if not len(names) == len(units) == n:
            raise InputError(f"the group has {n} velocities; got {len(names)} names, {len(units)} units")
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
    """The default generalised force: the input u (m,) of a system with as many inputs as velocities."""
    return u


def no_dissipation(q, v):
    """The default dissipation: zero (n,)."""
    return jnp.zeros_like(v)


def no_potential(q):
    """The default potential energy: zero, in the real type of q."""
    # For a complex type finfo gives the real part's type: on SU(n) matrices are complex, but the energy is real.
    return jnp.zeros((), jnp.finfo(q.dtype).dtype)


def check_model(model: MechanicalSystem, dimension: int | None = None) -> None:
    """Check that every function of a mechanical model has the shape that its configurations need.

    Args:
        model: The model; its functions are traced, not evaluated.
        dimension: Number of coordinates, for a model that does not name them.

    Raises:
        ValueError: A function has another shape, or circles are not coordinates; the message names the first fault.

    Example:
        >>> from covariant import models
        >>> from covariant.models._mechanical import check_model
        >>> check_model(models.oscillator())
    """
    known = dimension is None or None not in model.manifold.shape
    q = jax.eval_shape(model.manifold.origin) if known else jax.ShapeDtypeStruct((dimension,), jnp.float64)
    if any(not 0 <= i < q.shape[0] for i in model.circles):
        count = q.shape[0]
        raise InputError(f"circles {model.circles} must be indices of the {count} coordinates, 0 to {count - 1}")
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
    if model.feet is not None:
        shape = jax.eval_shape(model.feet, q).shape
        if len(shape) != 2 or shape[0] > u.shape[0]:
            raise InputError(
                f"feet must return positions (k, d) of k feet, of which each has one of the {u.shape[0]} inputs, the "
                f"last ones, that says whether it is on the ground; it returned shape {shape}"
            )


def check_shapes(functions, given: str, whom: str) -> None:
    """Check the shapes of functions without evaluating them."""
    for name, function, arguments, wanted in functions:
        try:
            shape = jax.eval_shape(function, *arguments).shape
        except (TypeError, ValueError, IndexError, AttributeError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"{name} cannot be evaluated with {given}: {reason}") from error
        if shape != wanted:
            raise InputError(f"{name} must return shape {wanted} for {whom}; it returned {shape}")


def applied_force(model: MechanicalSystem, t: Scalar, q: Array, u: Float[Array, "m"]) -> Vector:
    """Generalised force `−∂U + force` on the system, without its dissipation, in the frame.

    Args:
        model: Mechanical system.
        t: Time [s].
        q: Configuration.
        u: Input (m,).

    Returns:
        Covector (n,).

    Raises:
        ValueError: The force has another shape, for example a single input that would act on all coordinates.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> spring = models.oscillator(stiffness=3.0)
        >>> models.applied_force(spring, 0.0, jnp.array([2.0]), jnp.array([1.0])).tolist()
        [-5.0]
    """
    # The shapes must be equal, since one input broadcast over all coordinates would go unnoticed.
    force, slope = model.force(t, q, u), differential(model.manifold, model.potential, q)
    if force.shape != slope.shape:
        raise InputError(f"force must return shape {slope.shape}; with {u.shape[0]} inputs it returned {force.shape}")
    return force - slope  # the differential dU points uphill


def source(model: MechanicalSystem, t: Scalar, q: Array, u: Float[Array, "m"]) -> Vector:
    """Acceleration `S(q, t) = raise(−∂U + force)` of the system at rest without friction.

    Args:
        model: Mechanical system.
        t: Time [s].
        q: Configuration.
        u: Input (m,).

    Returns:
        Acceleration (n,), in the frame.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> spring = models.oscillator(stiffness=3.0)  # unit mass
        >>> models.source(spring, 0.0, jnp.array([2.0]), jnp.zeros(1)).tolist()
        [-6.0]
    """
    return model.space.raise_(q, applied_force(model, t, q, u))


def resistance(model: MechanicalSystem, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"]) -> Array:
    """Dissipation of the model, for either signature of its function.

    Args:
        model: Mechanical system.
        t: Time [s].
        q: Configuration.
        v: Velocity (n,).
        u: Input (m,).

    Returns:
        Generalised force (n,), in the frame.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> top = models.heavy_top(viscous=0.5)
        >>> models.resistance(top, 0.0, jnp.eye(3), jnp.array([0.0, 0.0, 2.0]), jnp.zeros(3))[2].item()
        -1.0
    """
    return model.dissipation(t, q, v, u) if model.dissipation_is_driven else model.dissipation(q, v)


def friction(model: MechanicalSystem, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"]) -> Vector:
    """Acceleration `raise(dissipation)` due to the dissipation.

    Args:
        model: Mechanical system.
        t: Time [s].
        q: Configuration.
        v: Velocity (n,).
        u: Input (m,).

    Returns:
        Acceleration (n,), in the frame.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> top = models.heavy_top(inertia=(0.2, 0.2, 0.1), viscous=0.5)
        >>> v_dot = models.friction(top, 0.0, jnp.eye(3), jnp.array([0.0, 0.0, 2.0]), jnp.zeros(3))
        >>> v_dot[2].round(9).item()
        -10.0
    """
    return model.space.raise_(q, resistance(model, t, q, v, u))


def input_count(model: Any, n: int) -> int:
    """Number of inputs m of a model.

    Args:
        model: A model with an attribute `inputs`.
        n: Its number of velocities; it is the result if the model does not state a number of inputs.

    Returns:
        The number m.

    Example:
        >>> from covariant import models
        >>> models.input_count(models.hovercraft(), 3)
        2
    """
    return n if model.inputs is None else model.inputs


def acceleration(model: MechanicalSystem, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"]) -> Vector:
    """Forward dynamics `v' = raise(−∂U + force + dissipation − M B(v, v))` (Hamel's equations).

    Use it to write a simulation, a controller or a test of a model by hand; it works under `jit`, `vmap` and `grad`.
    Each call solves a linear system with the inertia matrix. `simulation.simulate` integrates it with adaptive steps.
    On a group, v' is the rate of the components in the body frame and not a coordinate acceleration.

    Args:
        model: Mechanical system.
        t: Time [s].
        q: Configuration.
        v: Velocity (n,).
        u: Input (m,).

    Returns:
        v' (n,), in the frame.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.acceleration(models.oscillator(), 0.0, jnp.array([0.5]), jnp.zeros(1), jnp.zeros(1)).tolist()
        [-0.5]
    """
    covector = applied_force(model, t, q, u) + resistance(model, t, q, v, u)
    return model.space.acceleration(q, v, covector)


def energy(model: MechanicalSystem, q: Array, v: Vector) -> Scalar:
    """Kinetic plus potential energy [J].

    Use it to check a model or an integration: without force and dissipation the energy is constant, and friction must
    never increase it. The potential is defined up to a constant, so only differences have a meaning.

    Args:
        model: Mechanical system.
        q: Configuration.
        v: Velocity (n,).

    Returns:
        The energy, a scalar.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.energy(models.oscillator(), jnp.array([1.0]), jnp.array([2.0])).item()
        2.5
    """
    return model.space.inner(q, v, v) / 2 + model.potential(q)


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
    """Integrate the system over dt [s] in equal steps.

    Use it for one sample of a loop, in real time or inside a compiled function: the amount of work is fixed. The error
    of the default rule is of order (dt/steps)⁴, and stiff friction needs more steps. For a whole motion with a given
    tolerance use `simulation.simulate`.

    Args:
        system: Mechanical system.
        t: Time [s] at the start.
        motion: Motion at the start.
        u: Input (m,), held constant, or a function `(t, x) -> u` of the state x.
        dt: Duration [s].
        steps: Number of integration steps.
        rule: One-step method `(flow, t, x, dt) -> x` of `covariant._integrate`; by default the classical Runge–Kutta
            method of order 4.

    Returns:
        Motion at t + dt. The configuration of a system on a manifold stays on it.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> start = models.Motion(jnp.array([1.0]), jnp.array([0.0]))
        >>> end = models.advance(models.oscillator(), 0.0, start, jnp.zeros(1), jnp.pi, 50)  # half a period
        >>> end.q.round(4).tolist()
        [-1.0]
    """
    advanced = _in_coordinates if system.manifold.commuting else _in_frame
    return advanced(system, t, motion, u if callable(u) else lambda s, x: u, dt, steps, rule)


def _in_coordinates(system: MechanicalSystem, t: Number, motion: Motion, u: InputLaw, dt, steps, rule) -> Motion:
    @jax.jit  # traced once, although each step of the rule calls it several times
    def flow(s, now):
        return Motion(now.v, acceleration(system, s, now.q, now.v, u(s, system.state(now))))

    h = dt / jnp.asarray(steps, motion.v.dtype)

    # The time of a step is computed as a product, since a running sum of h would accumulate rounding errors.
    def step(i, now):
        return Motion(*system.space.restored(*rule(flow, t + jnp.asarray(i, h.dtype) * h, now, h)))

    return jax.lax.fori_loop(0, steps, step, motion)


def _in_frame(system: MechanicalSystem, t: Number, motion: Motion, u: InputLaw, dt, steps, rule) -> Motion:
    """Integrate on the manifold, so that the configuration stays on it.

    The second unknown of each step is the momentum in the frame at the start of the step. If no force acts on a part of
    it, as on a floating base, this part is constant to rounding for any step size.
    """
    h = dt / jnp.asarray(steps, motion.v.dtype)

    def step(i, now):
        begin = t + jnp.asarray(i, h.dtype) * h
        start = MomentumChart(system, now[0])

        @jax.jit  # traced once, although each step of the rule calls it several times
        def flow(s, x):
            return start.flow(s, x, u)[0]

        s, momentum = rule(flow, begin, (jnp.zeros_like(now[1]), now[1]), h)
        return start.end(s, momentum)

    q, momentum = jax.lax.fori_loop(0, steps, step, (motion.q, system.space.lower(*motion)))
    return Motion(q, system.space.raise_(q, momentum))


class MomentumChart(NamedTuple):
    """The equations of motion in a chart around a configuration.

    The unknowns are coordinates s (n,) of the retraction at the centre, and the momentum (n,) in the frame of the
    centre.
    With `μ = M v`, Hamel's equations are `μ' = ad*_v μ + ½∂<v, v> + force`; in the frame at the centre the first term
    vanishes.

    Attributes:
        system: Mechanical system.
        centre: Configuration at s = 0.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> chart = models.MomentumChart(models.free_body((1.0, 2.0, 4.0)), jnp.eye(3))
        >>> chart.motion(jnp.zeros(3), jnp.array([1.0, 2.0, 4.0])).v.tolist()
        [1.0, 1.0, 1.0]
    """

    system: MechanicalSystem
    centre: Inexact[Array, "..."]

    def motion(self, s: Vector, momentum: Vector) -> Motion:
        """Configuration and velocity at chart coordinates.

        Args:
            s: Coordinates (n,) of the retraction at the centre.
            momentum: Momentum (n,) in the frame of the centre.

        Returns:
            The motion, with its velocity in the frame at its configuration.
        """
        q = self.system.manifold.ambient.retract(self.centre, s)
        return Motion(q, self.system.space.raise_(q, self.system.manifold.carried_momentum(self.centre, s, momentum)))

    def flow(self, t: Scalar, now: tuple[Vector, Vector], u: InputLaw) -> tuple[tuple[Vector, Vector], Motion]:
        """Time derivatives of the chart coordinates and of the momentum.

        Args:
            t: Time [s].
            now: Coordinates s (n,) and momentum (n,).
            u: Input `(t, x) -> (m,)` of the motion x.

        Returns:
            The derivatives of s and of the momentum, and the motion at which they were evaluated.
        """
        system, (s, momentum) = self.system, now
        q, v = x = self.motion(s, momentum)
        inputs = u(t, x)
        force = applied_force(system, t, q, inputs) + resistance(system, t, q, v, inputs)
        # The metric is differentiated only in ½∂<v, v>: using μ in place of v avoids the term M' v.
        force = force + system.space.kinetic_force(q, v, system.manifold.carried_momentum(self.centre, s, momentum))
        rate = system.manifold.local_rate(self.centre, s, v)
        # −s converts the force from the frame at q to the frame at the centre.
        return (rate, system.manifold.carried_momentum(self.centre, -s, force)), x

    def end(self, s: Vector, momentum: Vector) -> tuple[Array, Vector]:
        """Configuration at chart coordinates with the momentum in its frame: the start of the next chart.

        Args:
            s: Coordinates (n,) of the retraction at the centre.
            momentum: Momentum (n,) in the frame of the centre.

        Returns:
            The configuration, and the momentum (n,) carried to its frame.
        """
        space, manifold = self.system.space, self.system.manifold.ambient
        q, momentum = manifold.retract(self.centre, s), manifold.carried_momentum(self.centre, s, momentum)
        return space.restored_momentum(q, momentum)
