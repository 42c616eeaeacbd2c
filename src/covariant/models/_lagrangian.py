"""A mechanical system `∇_q̇ q̇ = −grad U + g⁻¹(force + dissipation)`, written once as JAX functions.

Source: Aghannan & Rouchon 2003, section II; dissipation is an addition every machine needs.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import MatrixField, Scalar, Vector
from covariant.geometry import AbstractMetric, Metric, as_metric, christoffel, gradient


class Parameter(NamedTuple):
    """A number of a model with its unit and where it comes from."""

    value: float | tuple[float, ...]
    unit: str
    source: str


class Lagrangian(eqx.Module):
    """A Lagrangian system with measured positions.

    - `metric`: inertia matrix `q (n,) -> (n, n)`, or an `AbstractMetric`.
    - `potential`: potential energy `q -> ()` [J].
    - `force`: generalised force (covector) `(t, q, u) -> (n,)` of the input u (m,); by default u itself.
    - `dissipation`: generalised friction force `(q, v) -> (n,)`, evaluated at the estimate by observers. It opposes the
      motion: viscous friction b is `lambda q, v: -b * v`.
    - `circles`: indices of coordinates that are angles on a full circle [rad]; errors in them are wrapped to ±π.
    - `coordinates`, `units`: names and units of the coordinates; when given, all functions are checked at once.
    - `inputs`: number of inputs m where it is not n.
    - `parameters`: `Parameter` by name, for people.

    Raises `ValueError` when a function has the wrong shape.
    """

    metric: AbstractMetric
    potential: Callable[[Array], Array]
    force: Callable[[Array, Array, Array], Array]
    dissipation: Callable[[Array, Array], Array]
    circles: tuple[int, ...] = eqx.field(static=True)
    coordinates: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    inputs: int | None = eqx.field(static=True)
    parameters: dict[str, Parameter] = eqx.field(static=True)

    def __init__(
        self,
        metric: AbstractMetric | MatrixField,
        potential: Callable[[Array], Array],
        force: Callable[[Array, Array, Array], Array] | None = None,
        dissipation: Callable[[Array, Array], Array] | None = None,
        circles: tuple[int, ...] = (),
        *,
        coordinates: tuple[str, ...] = (),
        units: tuple[str, ...] = (),
        inputs: int | None = None,
        parameters: dict[str, Parameter] | None = None,
    ):
        self.metric = as_metric(metric)
        self.potential = potential
        self.force = input_itself if force is None else force
        self.dissipation = no_dissipation if dissipation is None else dissipation
        self.circles = tuple(circles)
        self.coordinates = tuple(coordinates)
        self.units = tuple(units)
        self.inputs = inputs
        self.parameters = FrozenDict(parameters or {})
        if self.coordinates:
            check_model(self, len(self.coordinates))


class FrozenDict(dict):
    """A dictionary that may sit in a static field: hashed by its content, never changed."""

    def __hash__(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return hash(tuple(self.items()))


def input_itself(t, q, u):
    return u


def no_dissipation(q, v):
    return jnp.zeros_like(v)


def check_model(model: Lagrangian, n: int) -> None:
    """Raise `ValueError` unless every function of the model has the shape that n coordinates need."""
    if any(not 0 <= i < n for i in model.circles):
        raise ValueError(f"circles {model.circles} must be indices of the {n} coordinates, 0 to {n - 1}")
    q = jax.ShapeDtypeStruct((n,), jnp.float64)
    u = jax.ShapeDtypeStruct((n if model.inputs is None else model.inputs,), jnp.float64)
    t = jax.ShapeDtypeStruct((), jnp.float64)
    metric = model.metric.matrix if isinstance(model.metric, Metric) else model.metric
    functions = (
        ("metric", metric, (q,), (n, n)),
        ("potential", model.potential, (q,), ()),
        ("force", model.force, (t, q, u), (n,)),
        ("dissipation", model.dissipation, (q, q), (n,)),
    )
    check_shapes(functions, f"{n} coordinates and {u.shape[0]} inputs", f"{n} coordinates")


def check_shapes(functions, given: str, whom: str) -> None:
    """Raise `ValueError` for the first of the functions (name, function, arguments, shape) that has another shape."""
    for name, function, arguments, wanted in functions:
        try:
            shape = jax.eval_shape(function, *arguments).shape
        except (TypeError, ValueError, IndexError, AttributeError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{name} cannot be evaluated with {given}: {reason}") from error
        if shape != wanted:
            raise ValueError(f"{name} must return shape {wanted} for {whom}; it returned {shape}")


@functools.singledispatch
def applied_force(model: Lagrangian, t: Scalar, q: Vector, u: Float[Array, "m"]) -> Vector:
    """`−∇U + force`, the generalised force on the system without friction; on a group in the body."""
    return model.force(t, q, u) - jax.grad(model.potential)(q)


@functools.singledispatch
def source(model: Lagrangian, t: Scalar, q: Vector, u: Float[Array, "m"]) -> Vector:
    """`S(q, t) = g⁻¹(−∇U + force)`, the acceleration of the system at rest without friction."""
    return gradient(model.metric, q, applied_force(model, t, q, u))


@functools.singledispatch
def friction(model: Lagrangian, q: Vector, v: Vector) -> Vector:
    """`g⁻¹ dissipation`, as an acceleration."""
    return gradient(model.metric, q, model.dissipation(q, v))


@functools.singledispatch
def acceleration(model: Lagrangian, t: Scalar, q: Vector, v: Vector, u: Float[Array, "m"]) -> Vector:
    """Forward dynamics `q̈ = −Γ(v, v) + g⁻¹(−∇U + force + dissipation)`."""
    covector = applied_force(model, t, q, u) + model.dissipation(q, v)
    return gradient(model.metric, q, covector) - christoffel(model.metric, q, v, v)


@functools.singledispatch
def energy(model: Lagrangian, q: Vector, v: Vector) -> Scalar:
    """Kinetic plus potential energy [J]."""
    return v @ model.metric(q) @ v / 2 + model.potential(q)


def position_error(model: Lagrangian, q: Vector, y: Vector) -> Vector:
    """`q − y` in coordinates, wrapped to ±π on circle joints; zero where the measurement is missing (NaN)."""
    return wrap(model.circles, jnp.where(jnp.isnan(y), 0.0, q - y))


def wrap(circles: tuple[int, ...], e: Vector) -> Vector:
    """Bring the entries of e (n,) that are angles on a circle to ±π."""
    # Entry by entry: what is no angle is not rounded, not even for nothing.
    turned = [x - 2 * np.pi * jnp.round(x / (2 * np.pi)) if i in circles else x for i, x in enumerate(e)]
    return jnp.stack(turned) if circles else e
