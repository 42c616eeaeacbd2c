"""Where configurations live: how they move, how they differ, and the frame their velocities are written in. No metric.

A configuration is an array x; a velocity is a column a (n,) of components in a frame `e_i`: ∂/∂q in coordinates, the
body's own axes on a group, one beside the other in a product. Everything that is not Riemannian is here.

Source: Absil, Mahony & Sepulchre 2008, Optimization Algorithms on Matrix Manifolds, chapter 4, for retractions.
"""

import abc
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Inexact

from covariant._typing import Flag, Vector

Configuration = Inexact[Array, "..."]
"""An array that is a configuration: (n,) in coordinates, (N, N) on a matrix group, flat in a product."""


class AbstractManifold(eqx.Module):
    """A configuration manifold with a frame and a retraction.

    The retraction `s ↦ retract(x, s)` draws coordinates s (n,) around x, in which `local` reads a configuration. A
    curve through x with the frame velocity a has `x' = tangent(x, a)`.
    """

    @property
    def commuting(self) -> bool:
        """Whether the frame is that of coordinates: brackets vanish, and s are the coordinates' differences."""
        return False

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int | None, ...]:
        """The shape of x; None where any length will do."""

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...] | None:
        """Which entries of s (n,) are rotation vectors [rad], or angles on a circle; None where nobody knows.

        Where all of them are shorter than π, `retract` is undone by `local`, smoothly.
        """
        return None

    @property
    def factors(self) -> "tuple[AbstractManifold, ...]":
        """The manifolds that this one is a product of; none where it is no product."""
        return ()

    @property
    def circles(self) -> tuple[int, ...]:
        """Indices of the entries of x that are angles on a full circle [rad]."""
        return ()

    @abc.abstractmethod
    def origin(self, dtype: Any = float) -> Configuration:
        """Some configuration: the neutral element, coordinates 0. Raises `ValueError` where their number is unknown."""

    @abc.abstractmethod
    def zero(self, x: Configuration) -> Vector:
        """The velocity (n,) of rest at x."""

    @abc.abstractmethod
    def tangent(self, x: Configuration, a: Vector) -> Configuration:
        """`E(x)a`: the rate of change of the array x of a configuration that moves with a."""

    def nudged(self, x: Configuration, a: Vector) -> Configuration:
        """`x + tangent(x, a)`: where a small step a leads to first order, for derivatives at a = 0."""
        return x + self.tangent(x, a)

    @abc.abstractmethod
    def components(self, x: Configuration, rate: Configuration) -> Vector:
        """The a for which `tangent(x, a)` is this rate of change."""

    @abc.abstractmethod
    def bracket(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """`[a, b]` of the vector fields with these components everywhere."""

    @abc.abstractmethod
    def retract(self, x: Configuration, s: Vector) -> Configuration:
        """The configuration that s leads to from x; to first order `x + tangent(x, s)`."""

    @abc.abstractmethod
    def local(self, x: Configuration, y: Configuration) -> Vector:
        """The shortest s with `retract(x, s) = y`."""

    @abc.abstractmethod
    def frame_velocity(self, x: Configuration, s: Vector, rate: Vector) -> Vector:
        """The velocity, in the frame at `retract(x, s)`, of a curve along which `s' = rate`."""

    @abc.abstractmethod
    def local_rate(self, x: Configuration, s: Vector, velocity: Vector) -> Vector:
        """The s' that makes `velocity` the frame velocity at `retract(x, s)`: `frame_velocity` undone."""

    def retraction_acceleration(self, x: Configuration, a: Vector) -> Vector:
        """`Q(a, a)`: how fast the frame velocity of `t ↦ retract(x, t a)` changes at t = 0."""
        return jax.jvp(lambda s: self.frame_velocity(x, s, a), (self.zero(x),), (a,))[1]

    @abc.abstractmethod
    def carried_momentum(self, x: Configuration, s: Vector, mu: Vector) -> Vector:
        """A momentum μ at x as the frame at `retract(x, s)` sees it, unchanged in space; with −s the other way."""

    @abc.abstractmethod
    def missing(self, y: Configuration) -> Bool[Array, "n"]:
        """Which components of `local(x, y)` a measurement y with NaN in it does not tell."""

    def measured_together(self, n: int) -> tuple[tuple[int, ...], ...]:
        """Which components of a velocity (n,) one sensor tells all at once, such as an attitude's; one tuple each."""
        return (tuple(range(n)),)

    @abc.abstractmethod
    def towards(self, x: Configuration, y: Configuration) -> Vector:
        """`local(x, y)` to a measurement y, with zeros for what is `missing` in it."""

    @abc.abstractmethod
    def measured(self, x: Configuration, y: Configuration) -> Configuration:
        """The configuration that a measurement y says, on the turn of its circles next to x; missing ones from x."""

    def unique(self, x: Configuration, y: Configuration) -> Flag:
        """False within rounding of where a second s as short as `local(x, y)` leads to y."""
        return jnp.ones((), bool)

    def checked(self, y: Configuration) -> Configuration:
        """The configuration y itself; an error when it runs and y is none. Raises `ValueError` for a wrong shape."""
        if len(y.shape) != len(self.shape) or any(w not in (None, n) for n, w in zip(y.shape, self.shape, strict=True)):
            wanted = ", ".join("n" if size is None else str(size) for size in self.shape)
            raise ValueError(f"a configuration must have shape ({wanted}); got {y.shape}")
        return y


class Coordinates(AbstractManifold):
    """Configurations written as coordinates q (n,), some of which may be angles on a full circle.

    - `circles`: indices of the coordinates that are such angles [rad]; differences of them are wrapped to ±π.
    - `dimension`: n, where it is known.
    """

    circles: tuple[int, ...] = eqx.field(default=(), static=True, converter=tuple)
    dimension: int | None = eqx.field(default=None, static=True)

    @property
    def commuting(self) -> bool:
        return True

    @property
    def shape(self) -> tuple[int | None, ...]:
        return (self.dimension,)

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...]:
        return tuple((i,) for i in self.circles)

    def origin(self, dtype: Any = float) -> Vector:
        if self.dimension is None:
            raise ValueError("the number of coordinates is not known; name them, or give Coordinates(dimension=...)")
        return jnp.zeros(self.dimension, dtype)

    def zero(self, x: Vector) -> Vector:
        return jnp.zeros_like(x)

    def tangent(self, x: Vector, a: Vector) -> Vector:
        return a

    def components(self, x: Vector, rate: Vector) -> Vector:
        return rate

    def bracket(self, x: Vector, a: Vector, b: Vector) -> Vector:
        return jnp.zeros_like(a)

    def retract(self, x: Vector, s: Vector) -> Vector:
        return x + s

    def local(self, x: Vector, y: Vector) -> Vector:
        return wrap(self.circles, y - x)

    def frame_velocity(self, x: Vector, s: Vector, rate: Vector) -> Vector:
        return rate

    def local_rate(self, x: Vector, s: Vector, velocity: Vector) -> Vector:
        return velocity

    def retraction_acceleration(self, x: Vector, a: Vector) -> Vector:
        return jnp.zeros_like(a)

    def carried_momentum(self, x: Vector, s: Vector, mu: Vector) -> Vector:
        return mu

    def missing(self, y: Vector) -> Bool[Array, "n"]:
        return jnp.isnan(y)

    def measured_together(self, n: int) -> tuple[tuple[int, ...], ...]:
        return tuple((i,) for i in range(n))

    def towards(self, x: Vector, y: Vector) -> Vector:
        return wrap(self.circles, jnp.where(jnp.isnan(y), 0.0, y - x))

    def measured(self, x: Vector, y: Vector) -> Vector:
        return x + self.towards(x, y)


def wrap(circles: tuple[int, ...], e: Vector) -> Vector:
    """Bring the entries of e (n,) that are angles on a circle to ±π."""
    # Entry by entry: what is no angle is not rounded, not even for nothing.
    turned = [x - 2 * np.pi * jnp.round(x / (2 * np.pi)) if i in circles else x for i, x in enumerate(e)]
    return jnp.stack(turned) if circles else e


class ProductManifold(AbstractManifold):
    """Several manifolds as one, such as the pose of a satellite and the angles of its arm.

    A configuration is one array (m,): those of the factors, flat, one after the other; so are velocities. Each factor
    must know the shape of its configurations.
    """

    manifolds: tuple[AbstractManifold, ...]

    def __check_init__(self):
        if not self.manifolds:
            raise ValueError("ProductManifold: give at least one factor")
        for factor in self.manifolds:
            if None in factor.shape:
                raise ValueError("ProductManifold: say how many coordinates there are, as in Coordinates(dimension=2)")

    @property
    def factors(self) -> tuple[AbstractManifold, ...]:
        return self.manifolds

    @property
    def commuting(self) -> bool:
        return all(factor.commuting for factor in self.factors)

    @property
    def shape(self) -> tuple[int]:
        return (sum(self._sizes),)

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...] | None:
        found = []
        for factor, start in zip(self.factors, starts(self._dimensions), strict=True):
            if factor.rotations is None:
                return None
            found += [tuple(start + i for i in turn) for turn in factor.rotations]
        return tuple(found)

    def measured_together(self, n: int) -> tuple[tuple[int, ...], ...]:
        each = zip(self.factors, starts(self._dimensions), self._dimensions, strict=True)
        return tuple(tuple(k + i for i in piece) for f, k, size in each for piece in f.measured_together(size))

    @property
    def circles(self) -> tuple[int, ...]:
        each = zip(starts(self._sizes), self.factors, strict=True)
        return tuple(start + i for start, factor in each for i in factor.circles)

    def origin(self, dtype: Any = float) -> Configuration:
        return self.join([factor.origin(dtype) for factor in self.factors])

    def parts(self, x: Configuration) -> list[Array]:
        """The configurations of the factors."""
        flat = split(x, self._sizes)
        return [part.reshape(factor.shape) for factor, part in zip(self.factors, flat, strict=True)]

    def join(self, parts: list[Array]) -> Array:
        """The configuration with these parts."""
        return jnp.concatenate([part.reshape(-1) for part in parts])

    def vectors(self, a: Vector) -> list[Array]:
        """The velocities of the factors in one of their product."""
        return split(a, self._dimensions)

    def zero(self, x: Configuration) -> Vector:
        return jnp.zeros(sum(self._dimensions), x.dtype)

    def tangent(self, x: Configuration, a: Vector) -> Configuration:
        return self._each("tangent", self.parts(x), self.vectors(a))

    def components(self, x: Configuration, rate: Configuration) -> Vector:
        return self._each("components", self.parts(x), self.parts(rate))

    def bracket(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        return self._each("bracket", self.parts(x), self.vectors(a), self.vectors(b))

    def retract(self, x: Configuration, s: Vector) -> Configuration:
        return self._each("retract", self.parts(x), self.vectors(s))

    def local(self, x: Configuration, y: Configuration) -> Vector:
        return self._each("local", self.parts(x), self.parts(y))

    def frame_velocity(self, x: Configuration, s: Vector, rate: Vector) -> Vector:
        return self._each("frame_velocity", self.parts(x), self.vectors(s), self.vectors(rate))

    def local_rate(self, x: Configuration, s: Vector, velocity: Vector) -> Vector:
        return self._each("local_rate", self.parts(x), self.vectors(s), self.vectors(velocity))

    def retraction_acceleration(self, x: Configuration, a: Vector) -> Vector:
        return self._each("retraction_acceleration", self.parts(x), self.vectors(a))

    def carried_momentum(self, x: Configuration, s: Vector, mu: Vector) -> Vector:
        return self._each("carried_momentum", self.parts(x), self.vectors(s), self.vectors(mu))

    def missing(self, y: Configuration) -> Bool[Array, "n"]:
        return self._each("missing", self.parts(y))

    def towards(self, x: Configuration, y: Configuration) -> Vector:
        return self._each("towards", self.parts(x), self.parts(y))

    def measured(self, x: Configuration, y: Configuration) -> Configuration:
        return self._each("measured", self.parts(x), self.parts(y))

    def unique(self, x: Configuration, y: Configuration) -> Flag:
        each = zip(self.factors, self.parts(x), self.parts(y), strict=True)
        return jnp.all(jnp.stack([factor.unique(a, b) for factor, a, b in each]))

    def checked(self, y: Configuration) -> Configuration:
        return self._each("checked", self.parts(super().checked(y)))

    @property
    def _sizes(self) -> list[int]:
        return [math.prod(size or 0 for size in factor.shape) for factor in self.factors]

    @property
    def _dimensions(self) -> list[int]:
        shapes = [jax.ShapeDtypeStruct(factor.shape, float) for factor in self.factors]  # pyright: ignore[reportArgumentType]
        pairs = zip(self.factors, shapes, strict=True)
        return [jax.eval_shape(factor.zero, shape).shape[0] for factor, shape in pairs]

    def _each(self, operation: str, *arguments: list[Array]) -> Array:
        parts = zip(self.factors, *arguments, strict=True)
        return self.join([getattr(factor, operation)(*each) for factor, *each in parts])


def split(a: Array, sizes: Sequence[int], axis: int = 0) -> list[Array]:
    """Cut an array along an axis into pieces of these lengths."""
    return jnp.split(a, starts(sizes)[1:], axis=axis)


def starts(sizes: Sequence[int]) -> list[int]:
    """Where each of pieces of these lengths begins, one after the other."""
    return [sum(sizes[:i]) for i in range(len(sizes))]
