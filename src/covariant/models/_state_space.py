"""Defines general nonlinear systems `x' = f(t, x, u)`, `y = h(t, x, u)` as JAX functions."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Matrix, Scalar, Vector
from covariant.geometry import Coordinates, wrap
from covariant.models._mechanical import MechanicalSystem, Sought, acceleration, check_shapes, input_count
from covariant.models._parameters import Inputs, Parameter, name_inputs
from scalargraph.errors import InputError


class StateSpace(Functional):
    """A nonlinear system `x' = f(t, x, u)`, `y = h(t, x, u)` with measured outputs; its Jacobians are automatic.

    Use it for systems that are not mechanical, such as tanks, reactors or electric machines, and for mechanical ones
    whose measurements are not positions. If positions are measured, use `Lagrangian` or `GroupSystem`: observers can
    then use the geometry, and constant gains with a known error law. `f` and `h` must be JAX functions. Mark outputs
    that are angles by `circles`, otherwise a full turn counts as an error.

    Attributes:
        f: State derivative `(t, x, u) -> (n,)` of the time t [s], the state x (n,) and the input u (m,).
        h: Output `(t, x, u) -> (p,)`.
        coordinates: Names of the states. If they are given, the constructor checks the shapes of f and h.
        units: Units of the states.
        outputs: Names of the outputs; y1, y2, … by default if coordinates are given.
        inputs: Number of inputs m, or the unit of each by its name; 0 by default.
        input_names, input_units: Names and units of the inputs, as far as they are given.
        circles: Indices of outputs that are angles on a full circle [rad]; errors in them are wrapped to ±π.
        box: Lower and upper bound of each state, within which the model is valid, for designs that need one.
        parameters: `Parameter` objects by name, as documentation.

    Raises:
        ValueError: A function has the wrong shape, or the names, units or box do not fit the state.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> decay = models.StateSpace(
        ...     lambda t, x, u: -2.0 * x, lambda t, x, u: x, coordinates=("level",), units=("m",)
        ... )
        >>> decay.outputs
        ('y1',)
        >>> decay.f(0.0, jnp.array([3.0]), jnp.zeros(0)).tolist()
        [-6.0]
    """

    f: Callable[[Array, Array, Array], Array]
    h: Callable[[Array, Array, Array], Array]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    inputs: int = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    input_units: tuple[str, ...] = eqx.field(static=True)
    circles: tuple[int, ...] = eqx.field(static=True)
    box: tuple[tuple[Scalar, Scalar], ...]
    parameters: dict[str, Parameter]

    def __init__(
        self,
        f: Callable[[Array, Array, Array], Array],
        h: Callable[[Array, Array, Array], Array],
        *,
        coordinates: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
        outputs: tuple[str, ...] = (),
        inputs: Inputs = 0,
        circles: tuple[int, ...] = (),
        box: tuple[tuple[float, float], ...] = (),
        parameters: dict[str, Parameter] | None = None,
    ):
        self.f, self.h = f, h
        self.coordinates, self.units = tuple(coordinates), tuple(units)
        count, self.input_names, self.input_units = name_inputs(inputs)
        self.inputs, self.circles = count or 0, tuple(circles)
        self.box = tuple((jnp.asarray(low, float), jnp.asarray(high, float)) for low, high in box)
        self.parameters = dict(parameters or {})
        self.outputs = tuple(outputs)
        if self.coordinates:
            count = _check(self, box)
            self.outputs = self.outputs or tuple(f"y{i + 1}" for i in range(count))

    velocities = tuple[str, ...]()
    """Names of velocities: empty, since a state-space model has states only."""

    velocity_units = velocities
    feet = force = space = None  # what only a mechanical system has

    @property
    def output_units(self) -> tuple[str, ...]:
        """Units of the outputs: those of the states of the same names, "" of others."""
        known = dict(zip(self.coordinates, self.units, strict=False))
        return tuple(known.get(name, "") for name in self.outputs)

    @property
    def logged_units(self) -> dict[str, tuple[str, ...]]:
        """Known units of the logged quantities.

        Returns:
            Units of each entry of `truth`, the reference states, of the inputs `u` that have units, and of the outputs
            `q` if all of them do.
        """
        outputs = {"q": self.output_units} if all(self.output_units) else {}
        return outputs | {"truth": self.units, "u": self.input_units}

    @property
    def sought(self) -> Sought:
        """The quantity that an observer of the model estimates: all of its states.

        Returns:
            Its names, units and values.
        """
        return Sought("state", self.coordinates, self.units or ("",) * len(self.coordinates), jnp.asarray)

    @property
    def manifold(self) -> Coordinates:
        """The manifold of the outputs."""
        return Coordinates(self.circles, len(self.outputs))

    def jacobians(self, t: Scalar, x: Vector, u: Float[Array, "m"]) -> tuple[Matrix, Float[Array, "p n"]]:
        """Jacobians of the state derivative and of the output with respect to the state, by forward differentiation.

        Args:
            t: Time [s].
            x: State (n,).
            u: Input (m,).

        Returns:
            `∂f/∂x` (n, n) and `∂h/∂x` (p, n).
        """
        # Forward mode is used, as reverse mode needs as many passes for the square ∂f/∂x, and more memory.
        return jax.jacfwd(self.f, 1)(t, x, u), jax.jacfwd(self.h, 1)(t, x, u)

    def output_error(self, predicted: Float[Array, "p"], y: Float[Array, "p"]) -> Float[Array, "p"]:
        """Output error `predicted − y`, wrapped to ±π for circles; zero if the measurement is missing (NaN).

        Args:
            predicted: Predicted output (p,).
            y: Measured output (p,).

        Returns:
            The error (p,).
        """
        # Wrapping comes last, since the difference of two angles may exceed ±π.
        return wrap(self.circles, jnp.where(jnp.isnan(y), 0.0, predicted - y))


@functools.singledispatch
def state_space(model: MechanicalSystem) -> StateSpace:
    """Convert a model to state-space form.

    Use it for observers and designs that need x and y: `Contracting`, `StateEKF`, `Riccati` and the metrics. The result
    no longer has the geometry, so `Intrinsic` and the certificates of intrinsic observers do not accept it. A system on
    a group has no such form.

    Args:
        model: A mechanical system in coordinates, with x = (q, v) and y = q; a `marine.Craft`, with x = (η, ν) and y =
            η; or a `StateSpace`, which is returned unchanged.

    Returns:
        The state-space model, with the names, units, circles and parameters of `model`.

    Raises:
        ValueError: The machine has closed loops, whose coordinates depend on each other.

    Example:
        >>> from covariant import models
        >>> models.state_space(models.ball_and_beam()).coordinates
        ('r', 'theta', 'r_dot', 'theta_dot')
    """
    if model.manifold.redundant:
        raise InputError(
            "a machine with closed loops has no state-space form: its coordinates depend on each other, so that a box "
            "of states, a gain or a metric in them would be about open loops; use Intrinsic or IntrinsicKalman"
        )
    names = model.coordinates
    rates = tuple(f"{name}_dot" for name in names)

    return StateSpace(
        eqx.Partial(_motion_rate, model),
        _position,
        coordinates=(*names, *rates),
        units=(*model.units, *(f"{unit}/s" for unit in model.units)),
        outputs=names,
        inputs=input_count(model, len(names)),
        circles=model.circles,
        parameters=model.parameters,
    )


@state_space.register
def _(model: StateSpace) -> StateSpace:
    return model


def _motion_rate(
    model: MechanicalSystem, t: Scalar, x: Float[Array, "two_n"], u: Float[Array, "m"]
) -> Float[Array, "two_n"]:
    q, v = jnp.split(x, 2)
    return jnp.concatenate([v, acceleration(model, t, q, v, u)])


def _position(t: Scalar, x: Float[Array, "two_n"], u: Float[Array, "m"]) -> Vector:
    return jnp.split(x, 2)[0]


def _check(model: StateSpace, box: Sequence[tuple[Any, Any]]) -> int:
    """Check shapes, circles, units and box against the n coordinates, and return the number of outputs."""
    n = len(model.coordinates)
    t, x, u = (jax.ShapeDtypeStruct(shape, jnp.float64) for shape in ((), (n,), (model.inputs,)))
    arguments_text, states_text = f"{n} states and {model.inputs} inputs", f"{n} states"
    check_shapes((("f", model.f, (t, x, u), (n,)),), arguments_text, states_text)
    count = len(model.outputs)
    if not count:
        shape = getattr(jax.eval_shape(model.h, t, x, u), "shape", None)
        if shape is None or len(shape) != 1 or not shape[0]:
            raise InputError(f"h must return a vector of outputs (p,), p ≥ 1; it returned {shape}")
        count = shape[0]
    check_shapes((("h", model.h, (t, x, u), (count,)),), arguments_text, f"{count} outputs")
    if any(not 0 <= i < count for i in model.circles):
        raise InputError(f"circles {model.circles} must be indices of the {count} outputs, 0 to {count - 1}")
    for name, entries in (("units", model.units), ("box", box)):
        if entries and len(entries) != n:
            raise InputError(f"{name} needs one entry for each of the {n} states; it has {len(entries)}")
    for name, (low, high) in zip(model.coordinates, box, strict=False):
        # Python cannot branch on traced numbers, so bounds that are open in a fit are not checked.
        if not (isinstance(low, Tracer) or isinstance(high, Tracer) or low < high):
            raise InputError(f"box of {name}: the lower bound {low:g} must be below the upper one {high:g}")
    return count
