"""Manifolds of configurations without a metric: retraction, local coordinates and the frame of velocities.

A configuration is an array x; a velocity is a column a (n,) of components in a frame `e_i`: ∂/∂q in coordinates, the
body frame on a group, and the frames of the factors side by side in a product. All geometry without a metric is here.

Source: Absil, Mahony & Sepulchre 2008, Optimization Algorithms on Matrix Manifolds, chapter 4, for retractions.
"""

import abc
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Inexact

from covariant._typing import Flag, Vector
from scalargraph.errors import InputError

Configuration = Inexact[Array, "..."]
"""An array that is a configuration: (n,) in coordinates, (N, N) on a matrix group, flattened in a product."""


class AbstractManifold(eqx.Module):
    """A configuration manifold with a frame and a retraction.

    The retraction `s ↦ retract(x, s)` defines coordinates s (n,) around x; `local` returns the coordinates of a
    configuration. A curve through x with the frame velocity a has `x' = tangent(x, a)`.

    Example:
        The midpoint of two configurations, on any manifold:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import AbstractManifold, Coordinates, lie
        >>> def midpoint(manifold: AbstractManifold, x, y):
        ...     return manifold.retract(x, manifold.local(x, y) / 2)
        >>> midpoint(Coordinates(), jnp.array([0.0, 2.0]), jnp.array([1.0, 4.0])).tolist()
        [0.5, 3.0]
        >>> rotation = midpoint(lie.SO2, lie.SO2.exp(jnp.array([0.2])), lie.SO2.exp(jnp.array([0.6])))
        >>> round(float(lie.SO2.log(rotation)[0]), 6)
        0.4
    """

    commuting = False
    """Whether the frame comes from coordinates: brackets vanish, and s are differences of the coordinates."""

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int | None, ...]:
        """Shape of x; None for a dimension of any length."""

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...] | None:
        """Indices of the entries of s (n,) that form a rotation vector or an angle on a circle [rad], as tuples.

        There is one tuple for each rotation vector or angle; None if this is unknown. If all of these vectors are
        shorter than π, `local` is the smooth inverse of `retract`.
        """
        return None

    factors = tuple["AbstractManifold", ...]()
    """The manifolds of which this one is a product; empty if it is not a product."""

    circles = tuple[int, ...]()
    """Indices of the entries of x that are angles on a full circle [rad]."""

    redundant = False
    """Whether some entries of x determine the others, as on a `Leaf`, so that not all have to be measured."""

    @property
    def ambient(self) -> "AbstractManifold":
        """The manifold whose retraction defines the coordinates s: itself; for a `Leaf`, that of the whole space."""
        return self

    @abc.abstractmethod
    def origin(self, dtype: jax.typing.DTypeLike = float) -> Configuration:
        """Base configuration: the neutral element of a group, or coordinates 0.

        Args:
            dtype: type of the real numbers, double precision by default.

        Returns:
            A configuration.

        Raises:
            ValueError: the dimension n is unknown.
        """

    @abc.abstractmethod
    def zero(self, x: Configuration) -> Vector:
        """The zero velocity (n,) at x."""

    @abc.abstractmethod
    def tangent(self, x: Configuration, a: Vector) -> Configuration:
        """Rate of change `E(x)a` of the array x when the configuration moves with the velocity a.

        Args:
            x: configuration.
            a: velocity (n,) in the frame at x.

        Returns:
            The derivative x', in the shape of x.
        """

    def nudged(self, x: Configuration, a: Vector) -> Configuration:
        """Configuration after a small step a, to first order: `x + tangent(x, a)`, for derivatives at a = 0.

        Args:
            x: configuration.
            a: step (n,) in the frame at x.

        Returns:
            An array in the shape of x, on the manifold to first order in a.
        """
        # It is linear in a and agrees with `retract` to first order, which suffices for derivatives at a = 0.
        return x + self.tangent(x, a)

    @abc.abstractmethod
    def components(self, x: Configuration, rate: Configuration) -> Vector:
        """Frame components of a rate of change: the inverse of `tangent`.

        Args:
            x: configuration.
            rate: derivative x', in the shape of x.

        Returns:
            The velocity a (n,) with `tangent(x, a) = rate`.
        """

    @abc.abstractmethod
    def bracket(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """Lie bracket `[a, b]` of the two vector fields whose frame components are a and b everywhere.

        Args:
            x: configuration at which the bracket is evaluated.
            a: components (n,) of the first field.
            b: components (n,) of the second field.

        Returns:
            Components (n,) of the bracket in the frame at x.
        """

    @abc.abstractmethod
    def retract(self, x: Configuration, s: Vector) -> Configuration:
        """The configuration at the coordinates s around x; to first order `x + tangent(x, s)`.

        Args:
            x: configuration at which s = 0.
            s: coordinates (n,) of the retraction.

        Returns:
            A configuration, in the shape of x.
        """

    @abc.abstractmethod
    def local(self, x: Configuration, y: Configuration) -> Vector:
        """Coordinates of y around x: the shortest s with `retract(x, s) = y`.

        Args:
            x: configuration at which s = 0.
            y: configuration.

        Returns:
            Coordinates s (n,).
        """

    @abc.abstractmethod
    def frame_velocity(self, x: Configuration, s: Vector, rate: Vector) -> Vector:
        """Frame velocity at `retract(x, s)` of a curve along which `s' = rate`.

        Args:
            x: configuration at which s = 0.
            s: coordinates (n,) of a point on the curve.
            rate: derivative s' (n,).

        Returns:
            The velocity (n,) in the frame at `retract(x, s)`.
        """

    @abc.abstractmethod
    def local_rate(self, x: Configuration, s: Vector, velocity: Vector) -> Vector:
        """Rate of change s' of the coordinates of a moving configuration: the inverse of `frame_velocity`.

        Args:
            x: configuration at which s = 0.
            s: coordinates (n,) of the moving configuration.
            velocity: its velocity (n,) in the frame at `retract(x, s)`.

        Returns:
            The derivative s' (n,).
        """

    def retraction_acceleration(self, x: Configuration, a: Vector) -> Vector:
        """Second-order term `Q(a, a)` of the retraction: rate of the frame velocity of `t ↦ retract(x, t a)` at t = 0.

        Args:
            x: configuration.
            a: velocity (n,) in the frame at x.

        Returns:
            The rate of change (n,) of the frame components.
        """
        # Along s = t a the rate s' = a is constant, so the frame velocity changes through s alone.
        return jax.jvp(lambda s: self.frame_velocity(x, s, a), (self.zero(x),), (a,))[1]

    @abc.abstractmethod
    def carried_momentum(self, x: Configuration, s: Vector, mu: Vector) -> Vector:
        """A momentum in the frame at x, expressed in the frame at `retract(x, s)`.

        As a momentum in space it is unchanged. With −s the conversion goes in the opposite direction.

        Args:
            x: configuration at which s = 0.
            s: coordinates (n,) of the other configuration.
            mu: momentum μ (n,), a covector in the frame at x.

        Returns:
            The same momentum (n,) in the frame at `retract(x, s)`.
        """

    @abc.abstractmethod
    def missing(self, y: Configuration) -> Bool[Array, "n"]:
        """Mask (n,) of the components of `local(x, y)` that are unknown because the measurement y has NaN in it."""

    def measured_together(self, n: int) -> tuple[tuple[int, ...], ...]:
        """Components of a velocity that are measured only together, such as those of an attitude.

        Args:
            n: number of components of a velocity.

        Returns:
            Groups of indices, one tuple for each; by default one group of all n.
        """
        return (tuple(range(n)),)

    @abc.abstractmethod
    def towards(self, x: Configuration, y: Configuration) -> Vector:
        """Innovation `local(x, y)` of a measurement y, with zeros for the components that are `missing` in it.

        Args:
            x: configuration, such as an estimate.
            y: measurement, in the shape of x, with NaN where it is missing.

        Returns:
            Coordinates (n,) of y around x, finite for finite x.
        """

    @abc.abstractmethod
    def measured(self, x: Configuration, y: Configuration) -> Configuration:
        """The configuration that y measures, with angles on the turn nearest to x.

        Args:
            x: configuration, such as an estimate, whose entries replace those that are missing in y.
            y: measurement, in the shape of x, with NaN where it is missing.

        Returns:
            A configuration without NaN, in the shape of x.
        """

    def shown(self, x: Configuration, present: Bool[Array, "n"], e: Vector) -> Vector:
        """The displacement that corresponds to small differences of the measured entries.

        Args:
            x: configuration.
            present: mask (n,) of the entries that are measured.
            e: their differences (n,), 0 for others.

        Returns:
            The displacement (n,): e itself; on a `Leaf` the displacement along it that fits best.
        """
        return e

    def told(self, x: Configuration, present: Bool[Array, "n"]) -> Bool[Array, "n"]:
        """Which components are determined if some are measured.

        Args:
            x: configuration close to the measurement.
            present: mask (n,) of the components that are measured.

        Returns:
            Mask (n,): the measured ones; on a `Leaf` all, if the measured ones determine the others.
        """
        return present

    def seen(self, x: Configuration, y: Configuration) -> Configuration:
        """The measurement y, with NaN only if it contains no information on an entry.

        Args:
            x: configuration close to the measurement.
            y: measurement, in the shape of x, with NaN where it is missing.

        Returns:
            y itself. On a `Leaf`, where some entries determine others, NaN remains only if all entries are missing.
        """
        return y

    def dead_centre(self, x: Configuration, y: Configuration) -> Flag:
        """Whether the measured entries of y leave others undetermined, which is possible on a `Leaf` only."""
        return jnp.zeros((), bool)

    def unique(self, x: Configuration, y: Configuration) -> Flag:
        """Whether `local(x, y)` is the only shortest s that leads from x to y.

        Args:
            x: configuration.
            y: configuration.

        Returns:
            False, to within rounding, if a second s of the same length also leads to y; else True.
        """
        return jnp.ones((), bool)

    def admitted(self, y: Configuration) -> Configuration:
        """The measurement y, or NaN in place of an array that is not a configuration; `missing` entries stay NaN."""
        return y

    def checked(self, y: Configuration) -> Configuration:
        """The configuration y, after a check of its shape and of its membership of the manifold.

        Args:
            y: configuration to check.

        Returns:
            y. In a compiled function the numbers are not known: NaN replaces an array that is not a configuration, so
            that a compiled program makes no calls to the outside and can be cached.

        Raises:
            ValueError: the shape is wrong or, outside compiled functions, the array is not a configuration.
        """
        if len(y.shape) != len(self.shape) or any(w not in (None, n) for n, w in zip(y.shape, self.shape, strict=True)):
            expected = ", ".join("n" if size is None else str(size) for size in self.shape)
            raise InputError(f"a configuration must have shape ({expected}); got {y.shape}")
        return y


class Coordinates(AbstractManifold):
    """Configurations written as coordinates q (n,), some of which may be angles on a full circle.

    It is the manifold of a machine with joints. Declare an angle as a circle only if it can turn fully: in a joint that
    is limited to ±200°, a difference of more than half a turn would be wrapped wrongly. `ProductManifold` combines
    coordinates with groups.

    Attributes:
        circles: indices of the coordinates that are such angles [rad]; differences of them are wrapped to ±π. None of
            them by default.
        dimension: number of coordinates n, if it is known.

    Example:
        A cart with a pendulum: position [m] and angle [rad]. From 3 rad to −3 rad it is 0.283 rad through ±π:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Coordinates
        >>> manifold = Coordinates(circles=(1,), dimension=2)
        >>> s = manifold.local(jnp.array([0.0, 3.0]), jnp.array([5.0, -3.0]))
        >>> [round(float(e), 3) for e in s]
        [5.0, 0.283]
    """

    circles: tuple[int, ...] = eqx.field(default=(), static=True, converter=tuple)
    dimension: int | None = eqx.field(default=None, static=True)

    commuting = True

    @property
    def shape(self) -> tuple[int | None, ...]:
        return (self.dimension,)

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...]:
        return tuple((i,) for i in self.circles)

    def origin(self, dtype: jax.typing.DTypeLike = float) -> Vector:
        if self.dimension is None:
            raise InputError("the number of coordinates is not known; name them, or give Coordinates(dimension=...)")
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
        # NaN is replaced before `wrap`, so that neither the value nor its derivative becomes NaN.
        return wrap(self.circles, jnp.where(jnp.isnan(y), 0.0, y - x))

    def measured(self, x: Vector, y: Vector) -> Vector:
        return x + self.towards(x, y)


def wrap(circles: tuple[int, ...], e: Vector) -> Vector:
    """Wrap the entries of e that are angles on a circle to ±π.

    Args:
        circles: indices of the entries that are angles [rad].
        e: differences of coordinates (n,).

    Returns:
        e (n,) with 2π-multiples removed from these entries; the others are unchanged to the last bit.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import wrap
        >>> [round(float(e), 3) for e in wrap((1,), jnp.array([6.0, 6.0]))]
        [6.0, -0.283]
    """
    # The entries are treated one by one, so that an entry that is not an angle is not even rounded.
    # `round` goes to even numbers, so π and −π stay; its derivative is 0, so the derivative of a wrapped angle is 1.
    wrapped = [x - 2 * np.pi * jnp.round(x / (2 * np.pi)) if i in circles else x for i, x in enumerate(e)]
    return jnp.stack(wrapped) if circles else e


class ProductManifold(AbstractManifold):
    """Several manifolds as one, such as the pose of a satellite and the angles of its arm.

    A configuration is one array (m,): the configurations of the factors, flattened, one after the other. Velocities are
    concatenated in the same order. Each factor must know the shape of its configurations.

    Attributes:
        manifolds: the factors, at least one.

    Raises:
        ValueError: there are no factors, or coordinates of unknown number among them.

    Example:
        An attitude and two angles: configurations have 9 + 2 entries, velocities 3 + 2.

        >>> from covariant.geometry import Coordinates, ProductManifold, lie
        >>> manifold = ProductManifold((lie.SO3, Coordinates(circles=(0, 1), dimension=2)))
        >>> x = manifold.origin()
        >>> x.shape, manifold.zero(x).shape, manifold.circles
        ((11,), (5,), (9, 10))
    """

    manifolds: tuple[AbstractManifold, ...]

    def __check_init__(self):
        if not self.manifolds:
            raise InputError("ProductManifold: give at least one factor")
        for factor in self.manifolds:
            if None in factor.shape:
                raise InputError("ProductManifold: say how many coordinates there are, as in Coordinates(dimension=2)")

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
        groups = []
        for factor, start in zip(self.factors, starts(self._dimensions), strict=True):
            # If the rotations of one factor are unknown, so are those of the product.
            if factor.rotations is None:
                return None
            groups += [tuple(start + i for i in turn) for turn in factor.rotations]
        return tuple(groups)

    def measured_together(self, n: int) -> tuple[tuple[int, ...], ...]:
        each = zip(self.factors, starts(self._dimensions), self._dimensions, strict=True)
        return tuple(tuple(k + i for i in piece) for f, k, size in each for piece in f.measured_together(size))

    @property
    def circles(self) -> tuple[int, ...]:
        each = zip(starts(self._sizes), self.factors, strict=True)
        return tuple(start + i for start, factor in each for i in factor.circles)

    def origin(self, dtype: jax.typing.DTypeLike = float) -> Configuration:
        return self.join([factor.origin(dtype) for factor in self.factors])

    def parts(self, x: Configuration) -> list[Array]:
        """Configurations of the factors, each in its own shape, from a configuration x (m,) of the product."""
        flat = split(x, self._sizes)
        return [part.reshape(factor.shape) for factor, part in zip(self.factors, flat, strict=True)]

    def join(self, parts: list[Array]) -> Array:
        """Configuration (m,) of the product, from the configurations of its factors: the inverse of `parts`."""
        return jnp.concatenate([part.reshape(-1) for part in parts])

    def vectors(self, a: Vector) -> list[Array]:
        """Velocities of the factors, from a velocity a (n,) of the product."""
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
        # Only shapes are evaluated: this gives the dimension of a velocity without computing one.
        return [jax.eval_shape(factor.zero, shape).shape[0] for factor, shape in pairs]

    def _each(self, operation: str, *arguments: list[Array]) -> Array:
        parts = zip(self.factors, *arguments, strict=True)
        return self.join([getattr(factor, operation)(*each) for factor, *each in parts])


def split(a: Array, sizes: Sequence[int], axis: int = 0) -> list[Array]:
    """Cut an array along an axis into consecutive pieces.

    Args:
        a: array.
        sizes: lengths of the pieces, which sum to the length of the axis.
        axis: axis to cut, the first by default.

    Returns:
        The pieces, in order.
    """
    return jnp.split(a, starts(sizes)[1:], axis=axis)


def starts(sizes: Sequence[int]) -> list[int]:
    """The offsets at which consecutive pieces of these lengths begin."""
    return [sum(sizes[:i]) for i in range(len(sizes))]
