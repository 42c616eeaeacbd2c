"""Coordinates and groups seen alike, so that the laws of an observer are written once for both.

A position x moves along `move(x, s a)`, and tangent vectors are columns (n,), in coordinates or in the body. Source:
Aghannan & Rouchon 2003, section II; Maithripala, Berg & Dayawansa 2004, section II.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Flag, Number, Scalar, Vector, Vectors
from covariant.geometry import Budget, Metric, transport_along
from covariant.models import GroupSystem, Lagrangian, source
from covariant.observers import AbstractFlowObserver, AbstractObserver, Geodesic, Group, Intrinsic

NEAR = Budget(newton=0, steps=1)
"""A geodesic to second order in the error, which is all that differences of second order need."""


_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled_quickly(function: _Function) -> _Function:
    """Compile a function that runs once, with the least effort: an audit is mostly the compiler's time."""
    options = {"xla_backend_optimization_level": 0}
    return eqx.filter_jit(function, compiler_options=options)  # pyright: ignore[reportCallIssue]


class AbstractPlace(eqx.Module):
    """Where an observer lives: its positions, and a connection between their tangent spaces."""

    model: eqx.AbstractVar[Any]

    @property
    @abc.abstractmethod
    def slot(self) -> str:
        """The field of a state that holds the position, and of its slope that holds the velocity."""

    @property
    @abc.abstractmethod
    def reach(self) -> tuple[float, float]:
        """Between where coordinates are drawn that are no circles."""

    @property
    @abc.abstractmethod
    def coordinates(self) -> tuple[tuple[str, ...], tuple[str, ...], tuple[int, ...]]:
        """Names and units of the coordinates, and which of them are circles."""

    @abc.abstractmethod
    def position(self, coordinates: Vector) -> Array:
        """The position with these coordinates."""

    @abc.abstractmethod
    def usable(self, coordinates: Vector) -> Flag:
        """Whether the model is finite there, and its metric positive definite."""

    @abc.abstractmethod
    def move(self, x: Array, a: Vector) -> Array:
        """Where the curve through x with velocity a is after unit time."""

    @abc.abstractmethod
    def nudge(self, x: Array, a: Vector) -> Array:
        """The same to first order, for derivatives at a = 0."""

    @abc.abstractmethod
    def tangent(self, x: Array, change: Array) -> Vector:
        """The column of a derivative of positions."""

    @abc.abstractmethod
    def bracket(self, a: Vector, b: Vector) -> Vector:
        """`[a, b]` of the fields with these columns everywhere."""

    @abc.abstractmethod
    def connection(self, x: Array, a: Vector, b: Vector) -> Vector:
        """`∇_a b` of the field with the column b everywhere."""

    @abc.abstractmethod
    def curvature(self, x: Array, a: Vector, b: Vector, c: Vector) -> Vector:
        """`R(a, b)c`."""

    @abc.abstractmethod
    def covector(self, x: Array, a: Vector) -> Vector:
        """`<a, ·>`."""

    @abc.abstractmethod
    def vector(self, x: Array, covector: Vector) -> Vector:
        """The vector whose `covector` this is."""

    @abc.abstractmethod
    def geodesic(self, x: Array, velocity: Vector, w: Vectors, steps: int) -> tuple[Array, Vectors]:
        """Where a geodesic is after unit time, and the vectors w (k, n) carried along it in parallel."""

    @abc.abstractmethod
    def counterpart(self, observer: AbstractFlowObserver, alpha: Number, beta: Number) -> AbstractFlowObserver:
        """The approximate observer for the exact one, and the exact one for any other."""

    def inputs(self, n: int) -> int:
        """Number of inputs."""
        return n if self.model.inputs is None else self.model.inputs

    def inner(self, x: Array, a: Vector, b: Vector) -> Scalar:
        """`<a, b>`."""
        return a @ self.covector(x, b)

    def norm(self, x: Array, a: Vector) -> Scalar:
        """`|a|`."""
        return jnp.sqrt(self.inner(x, a, a))

    def gram(self, x: Array, w: Vectors) -> Float[Array, "k k"]:
        """Inner products of the vectors w (k, n)."""
        return w @ jax.vmap(lambda a: self.covector(x, a))(w).T


class InCoordinates(AbstractPlace):
    """Positions are coordinates (n,)."""

    model: Lagrangian

    @property
    def slot(self) -> str:
        return "q"

    @property
    def reach(self) -> tuple[float, float]:
        return 0.2, 1.2

    @property
    def coordinates(self) -> tuple[tuple[str, ...], tuple[str, ...], tuple[int, ...]]:
        names = self.model.coordinates
        units = tuple("" if unit == "1" else unit for unit in self.model.units) or ("",) * len(names)
        return names, units, self.model.circles

    def position(self, coordinates: Vector) -> Array:
        return coordinates

    def usable(self, coordinates: Vector) -> Flag:
        g = self.model.metric(coordinates)
        values = jnp.linalg.eigvalsh(jnp.where(jnp.isfinite(g), g, 0.0))
        s = source(self.model, jnp.zeros(()), coordinates, jnp.zeros(self.inputs(coordinates.shape[0])))
        return jnp.all(jnp.isfinite(g)) & jnp.all(jnp.isfinite(s)) & (values[0] > 1e-12 * values[-1])

    def move(self, x: Array, a: Vector) -> Array:
        return x + a

    def nudge(self, x: Array, a: Vector) -> Array:
        return x + a

    def tangent(self, x: Array, change: Array) -> Vector:
        return change

    def bracket(self, a: Vector, b: Vector) -> Vector:
        return jnp.zeros_like(a)

    def connection(self, x: Array, a: Vector, b: Vector) -> Vector:
        return self.model.metric.christoffel(x, a, b)

    def curvature(self, x: Array, a: Vector, b: Vector, c: Vector) -> Vector:
        return self.model.metric.curvature(x, a, b, c)

    def covector(self, x: Array, a: Vector) -> Vector:
        return self.model.metric(x) @ a

    def vector(self, x: Array, covector: Vector) -> Vector:
        return solve(self.model.metric(x), covector)

    def geodesic(self, x: Array, velocity: Vector, w: Vectors, steps: int) -> tuple[Array, Vectors]:
        end = transport_along(self.model.metric, x, velocity, w, Budget(steps=steps))
        return end.q, end.w

    def counterpart(self, observer: AbstractFlowObserver, alpha: Number, beta: Number) -> AbstractFlowObserver:
        if isinstance(observer, Geodesic):
            return Intrinsic(self.model, alpha, beta)
        return Geodesic(self.model, alpha, beta, NEAR)


class OnGroup(AbstractPlace):
    """Positions are elements of a group (N, N), tangent vectors are seen from the body."""

    model: GroupSystem

    @property
    def slot(self) -> str:
        return "g"

    @property
    def reach(self) -> tuple[float, float]:
        return -1.0, 1.0

    @property
    def coordinates(self) -> tuple[tuple[str, ...], tuple[str, ...], tuple[int, ...]]:
        n = self.model.group.dimension
        return tuple(f"x{i + 1}" for i in range(n)), ("",) * n, ()

    def position(self, coordinates: Vector) -> Array:
        return self.model.group.exp(coordinates)

    def usable(self, coordinates: Vector) -> Flag:
        s = source(self.model, jnp.zeros(()), self.position(coordinates), jnp.zeros(self.model.inputs))
        return jnp.all(jnp.isfinite(s))

    def move(self, x: Array, a: Vector) -> Array:
        return x @ self.model.group.exp(a)

    def nudge(self, x: Array, a: Vector) -> Array:
        return x + x @ self.model.group.hat(a)

    def tangent(self, x: Array, change: Array) -> Vector:
        return self.model.group.vee(self.model.group.inverse(x) @ change)

    def bracket(self, a: Vector, b: Vector) -> Vector:
        """Of the matrices, so that the group's own formula is put to the test."""
        one, two = self.model.group.hat(a), self.model.group.hat(b)
        return self.model.group.vee(one @ two - two @ one)

    def connection(self, x: Array, a: Vector, b: Vector) -> Vector:
        return self.model.metric.connection(a, b)

    def curvature(self, x: Array, a: Vector, b: Vector, c: Vector) -> Vector:
        return self.model.metric.curvature(a, b, c)

    def covector(self, x: Array, a: Vector) -> Vector:
        return self.model.metric.inertia(a)

    def vector(self, x: Array, covector: Vector) -> Vector:
        return self.model.metric.inertia.solve(covector)

    def geodesic(self, x: Array, velocity: Vector, w: Vectors, steps: int) -> tuple[Array, Vectors]:
        end = self.model.metric.transport_along(velocity, w, Budget(steps=steps))
        return x @ end.g, end.w

    def counterpart(self, observer: AbstractFlowObserver, alpha: Number, beta: Number) -> AbstractFlowObserver:
        if isinstance(observer, Group) and observer.error == "riemannian":
            return Group(self.model, alpha, beta)
        return Group(self.model, alpha, beta, error="riemannian", budget=NEAR)


def own(part: AbstractPlace | AbstractObserver, name: str) -> Any:
    """A field, or None where there is no such field."""
    return getattr(part, name) if name in {field.name for field in dataclasses.fields(part)} else None


def exchange(part: Any, model: Lagrangian) -> Any:
    """The same place or observer with another model."""
    fields: dict[str, Any] = {"model": model}
    return dataclasses.replace(part, **fields)


def traced_once(part: Any) -> Any:
    """The same place or observer, the matrix of a numerical metric being traced once, not once for every derivative."""
    model = own(part, "model")
    if not isinstance(model, Lagrangian) or type(model.metric) is not Metric:  # a subclass may do better
        return part
    return exchange(part, eqx.tree_at(lambda m: m.metric, model, Metric(jax.jit(model.metric.matrix))))
