"""Spaces defined by the matrix of a metric or by a kinetic energy, in coordinates or in the frame of a manifold."""

import abc
import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
from jaxtyping import Array

from covariant._linalg import solve
from covariant._typing import Matrix, MatrixField, Vector
from covariant.geometry._manifold import AbstractManifold, Configuration, Coordinates
from covariant.geometry._space import AbstractSpace
from scalargraph.errors import InputError


class AbstractMetric(AbstractSpace):
    """A space whose metric is a matrix at every configuration, `metric(x) -> (n, n)`.

    Attributes:
        manifold: manifold of the configurations; the matrix refers to its frame. By default plain coordinates.

    Example:
        A subclass defines the matrix:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import AbstractMetric
        >>> class Polar(AbstractMetric):
        ...     def __call__(self, x):
        ...         return jnp.diag(jnp.stack([jnp.ones(()), x[0] ** 2]))
        >>> float(Polar().norm(jnp.array([2.0, 0.0]), jnp.array([0.0, 1.5])))
        3.0
    """

    manifold: AbstractManifold = eqx.field(default=Coordinates(), kw_only=True)

    @abc.abstractmethod
    def __call__(self, x: Configuration) -> Matrix:
        """The metric's matrix (n, n) at x, in the frame."""

    def lower(self, x: Configuration, a: Vector) -> Vector:
        return self(x) @ a

    def raise_(self, x: Configuration, mu: Vector) -> Vector:
        return solve(self(x), mu)


class Metric(AbstractMetric):
    """A metric defined only by its matrix `x -> (n, n)`; every operation is derived from it.

    Use it for an inertia matrix in coordinates. `Lagrangian` also accepts the plain function. For a chain of many
    bodies `KineticEnergy` is cheaper, and a space with closed forms, such as `sphere`, is faster and exact. The matrix
    must be positive definite everywhere; this is not checked.

    Attributes:
        matrix: function of a configuration, with a symmetric positive definite matrix (n, n) as its value. The matrix
            refers to the frame of `manifold`; by default to coordinates.

    Example:
        The plane in polar coordinates (r, φ) is flat:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Metric, sectional_curvature
        >>> polar = Metric(lambda q: jnp.diag(jnp.stack([jnp.ones(()), q[0] ** 2])))
        >>> q, e_r, e_phi = jnp.array([2.0, 0.3]), jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
        >>> abs(float(sectional_curvature(polar, q, e_r, e_phi))) < 1e-12
        True
    """

    matrix: MatrixField

    def __call__(self, x: Configuration) -> Matrix:
        return self.matrix(x)


class KineticEnergy(AbstractSpace):
    """A space defined by its kinetic energy `(x, v) -> ½ <v, v>` [J], v being components in the manifold's frame.

    Energies are often easier to write than matrices, as for bodies in a chain. The momentum is the derivative
    `∂energy/∂v`, so its cost is that of a few energies, not that of all columns of a matrix.

    Attributes:
        energy: function of a configuration and a velocity (n,), quadratic in the velocity.
        manifold: manifold of the configurations; `Coordinates()` for generalised coordinates.

    Example:
        A cart of 3 kg; its momentum at 2 m/s [kg m/s]:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Coordinates, KineticEnergy
        >>> cart = KineticEnergy(lambda q, v: 1.5 * v[0] ** 2, manifold=Coordinates())
        >>> cart.lower(jnp.zeros(1), jnp.array([2.0])).tolist()
        [6.0]
    """

    energy: Callable[[Array, Array], Array]
    manifold: AbstractManifold = eqx.field(kw_only=True)

    def lower(self, x: Configuration, a: Vector) -> Vector:
        return jax.grad(self.energy, 1)(x, a)


def as_space(metric: AbstractSpace | MatrixField, manifold: AbstractManifold | None = None) -> AbstractSpace:
    """Space from a metric: a plain callable `q -> (n, n)` gets the derived operations.

    Use it at the entry of a function that takes either a space or a matrix field; the functions of this room call it
    themselves. A plain function has no circles: pass a `manifold` if some coordinates are angles.

    Args:
        metric: a space, or a function of coordinates (n,) with a symmetric positive definite matrix (n, n) as its
            value.
        manifold: manifold of the configurations, such as coordinates with circles; by default the manifold of the space
            or, for a function, plain coordinates.

    Returns:
        A space; without a `manifold`, a space is returned unchanged.

    Raises:
        ValueError: a `manifold` is passed with a space that is not in coordinates.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import as_space
        >>> space = as_space(lambda q: 4.0 * jnp.eye(1))
        >>> float(space.norm(jnp.zeros(1), jnp.array([3.0])))
        6.0
    """
    if not isinstance(metric, AbstractSpace):
        return Metric(metric, manifold=manifold or Coordinates())
    if manifold is None:
        return metric
    if not metric.manifold.commuting:
        raise InputError(f"the metric is on {metric.manifold}, not in coordinates; build a MechanicalSystem on it")
    return dataclasses.replace(metric, manifold=manifold)
