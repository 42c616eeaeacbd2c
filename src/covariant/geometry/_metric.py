"""A metric known by its matrix: in coordinates, or in the frame of any manifold."""

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


class AbstractMetric(AbstractSpace):
    """A space whose metric is a matrix at every configuration, `metric(x) -> (n, n)`."""

    manifold: AbstractManifold = eqx.field(default=Coordinates(), kw_only=True)

    @abc.abstractmethod
    def __call__(self, x: Configuration) -> Matrix:
        """The metric's matrix at x, in the frame."""

    def lower(self, x: Configuration, a: Vector) -> Vector:
        return self(x) @ a

    def raise_(self, x: Configuration, mu: Vector) -> Vector:
        return solve(self(x), mu)


class Metric(AbstractMetric):
    """A metric known only by its matrix `x -> (n, n)`; every operation is derived from it.

    With a `manifold` the matrix is in its frame: a machine whose inertia depends on its configuration, on whatever
    manifold that is; without, in coordinates.
    """

    matrix: MatrixField

    def __call__(self, x: Configuration) -> Matrix:
        return self.matrix(x)


class KineticEnergy(AbstractSpace):
    """A space known by its kinetic energy `(x, v) -> ½ <v, v>` [J], v being components in the manifold's frame.

    Where energies are easier to write than matrices, as of bodies in a chain, the momentum `∂energy/∂v` costs one
    velocity and not one for each column.
    """

    energy: Callable[[Array, Array], Array]
    manifold: AbstractManifold = eqx.field(kw_only=True)

    def lower(self, x: Configuration, a: Vector) -> Vector:
        return jax.grad(self.energy, 1)(x, a)


def as_space(metric: AbstractSpace | MatrixField, manifold: AbstractManifold | None = None) -> AbstractSpace:
    """A space from a metric: a plain callable `q -> (n, n)` gets the derived operations; a space is itself.

    With a `manifold`, the metric on that one, such as coordinates some of which are circles. Raises `ValueError` for a
    metric that is not in coordinates.
    """
    if not isinstance(metric, AbstractSpace):
        return Metric(metric, manifold=manifold or Coordinates())
    if manifold is None:
        return metric
    if not metric.manifold.commuting:
        raise ValueError(f"the metric is on {metric.manifold}, not in coordinates; build a MechanicalSystem on it")
    return dataclasses.replace(metric, manifold=manifold)
