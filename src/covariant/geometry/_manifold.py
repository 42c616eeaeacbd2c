"""Manifolds of configurations: how configurations move and differ, and the frame of their velocities. No metric.

A configuration is an array x; a velocity is a column a (n,) of components in a frame `e_i`: ∂/∂q in coordinates, the
body frame on a group, and those of the factors side by side in a product. All geometry without a metric is here.

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

    The retraction `s ↦ retract(x, s)` defines coordinates s (n,) around x; `local` gives those of a configuration. A
    curve through x with the frame velocity a has `x' = tangent(x, a)`.
    """

    @property
    def commuting(self) -> bool:
        """Whether the frame is that of coordinates: brackets vanish, and s are differences of the coordinates."""
        return False

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int | None, ...]:
        """The shape of x; None for a dimension of any length."""

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...] | None:
        """Which entries of s (n,) are rotation vectors [rad], or angles on a circle; None where this is unknown.

        Where all of them are shorter than π, `local` is the smooth inverse of `retract`.
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
        """A base configuration: the neutral element, or coordinates 0. Raises `ValueError` where n is unknown."""

    @abc.abstractmethod
    def zero(self, x: Configuration) -> Vector:
        """The zero velocity (n,) at x."""

    @abc.abstractmethod
    def tangent(self, x: Configuration, a: Vector) -> Configuration:
        """`E(x)a`: the rate of change of the array x of a configuration that moves with a."""

    def nudged(self, x: Configuration, a: Vector) -> Configuration:
        """`x + tangent(x, a)`: the configuration to first order after a small step a, for derivatives at a = 0."""
        return x + self.tangent(x, a)

    @abc.abstractmethod
    def components(self, x: Configuration, rate: Configuration) -> Vector:
        """The velocity a for which `tangent(x, a)` is this rate of change: the inverse of `tangent`."""

    @abc.abstractmethod
    def bracket(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """`[a, b]` of the vector fields that have these components everywhere."""

    @abc.abstractmethod
    def retract(self, x: Configuration, s: Vector) -> Configuration:
        """The configuration at the coordinates s around x; to first order `x + tangent(x, s)`."""

    @abc.abstractmethod
    def local(self, x: Configuration, y: Configuration) -> Vector:
        """The shortest s with `retract(x, s) = y`."""

    @abc.abstractmethod
    def frame_velocity(self, x: Configuration, s: Vector, rate: Vector) -> Vector:
        """The velocity, in the frame at `retract(x, s)`, of a curve along which `s' = rate`."""

    @abc.abstractmethod
    def local_rate(self, x: Configuration, s: Vector, velocity: Vector) -> Vector:
        """The s' for which `velocity` is the frame velocity at `retract(x, s)`: the inverse of `frame_velocity`."""

    def retraction_acceleration(self, x: Configuration, a: Vector) -> Vector:
        """`Q(a, a)`: how fast the frame velocity of `t ↦ retract(x, t a)` changes at t = 0."""
        return jax.jvp(lambda s: self.frame_velocity(x, s, a), (self.zero(x),), (a,))[1]

    @abc.abstractmethod
    def carried_momentum(self, x: Configuration, s: Vector, mu: Vector) -> Vector:
        """A momentum μ in the frame at x, expressed in the frame at `retract(x, s)`; with −s the other way round.

        As a momentum in space it is unchanged."""

    @abc.abstractmethod
    def missing(self, y: Configuration) -> Bool[Array, "n"]:
        """Which components of `local(x, y)` are unknown, y being a measurement with NaN in it."""

    def measured_together(self, n: int) -> tuple[tuple[int, ...], ...]:
        """Components of a velocity (n,) that are measured only together, such as those of an attitude; a tuple each."""
        return (tuple(range(n)),)

    @abc.abstractmethod
    def towards(self, x: Configuration, y: Configuration) -> Vector:
        """`local(x, y)` for a measurement y, with zeros for the components that are `missing` in it."""

    @abc.abstractmethod
    def measured(self, x: Configuration, y: Configuration) -> Configuration:
        """The configuration that y measures, with angles on the turn nearest to x; missing entries are those of x."""

    def unique(self, x: Configuration, y: Configuration) -> Flag:
        """False, to within rounding, where a second s of the length of `local(x, y)` also leads to y."""
        return jnp.ones((), bool)

    def admitted(self, y: Configuration) -> Configuration:
        """The measurement y, with NaN in the place of what is no configuration; what is `missing` stays as it is."""
        return y

    def checked(self, y: Configuration) -> Configuration:
        """The configuration y. Raises `ValueError` for a wrong shape, and where it is no configuration.

        Inside a compiled function its numbers are not known: there NaN stands in the place of what is none, so that a
        program calls nothing outside of it and can be kept.
        """
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
    # Entry by entry, so that an entry that is no angle is not even rounded.
    turned = [x - 2 * np.pi * jnp.round(x / (2 * np.pi)) if i in circles else x for i, x in enumerate(e)]
    return jnp.stack(turned) if circles else e


class ProductManifold(AbstractManifold):
    """Several manifolds as one, such as the pose of a satellite and the angles of its arm.

    A configuration is one array (m,): the configurations of the factors, flattened, one after the other. Velocities are
    concatenated likewise. Each factor must know the shape of its configurations.
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
        """The configurations of the factors, in their own shapes."""
        flat = split(x, self._sizes)
        return [part.reshape(factor.shape) for factor, part in zip(self.factors, flat, strict=True)]

    def join(self, parts: list[Array]) -> Array:
        """The configuration of the product with these configurations of the factors."""
        return jnp.concatenate([part.reshape(-1) for part in parts])

    def vectors(self, a: Vector) -> list[Array]:
        """The velocities of the factors, from a velocity of the product."""
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

    def admitted(self, y: Configuration) -> Configuration:
        return self._each("admitted", self.parts(y))

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
    """The offsets at which consecutive pieces of these lengths begin."""
    return [sum(sizes[:i]) for i in range(len(sizes))]
