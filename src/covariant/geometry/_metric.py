"""Spaces given by the matrix of their metric or by a kinetic energy, in coordinates or in the frame of any manifold."""

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
    """A metric given only by its matrix `x -> (n, n)`; every operation is derived from it.

    With a `manifold` the matrix is in the frame of that manifold, as for a machine whose inertia depends on its
    configuration; without one it is in coordinates.
    """

    matrix: MatrixField

    def __call__(self, x: Configuration) -> Matrix:
        return self.matrix(x)


class KineticEnergy(AbstractSpace):
    """A space given by its kinetic energy `(x, v) -> ½ <v, v>` [J], v being components in the manifold's frame.

    Energies are often easier to write than matrices, as for bodies in a chain. The momentum is the derivative
    `∂energy/∂v`, so its cost is that of a few energies, not that of all columns of a matrix.
    """

    energy: Callable[[Array, Array], Array]
    manifold: AbstractManifold = eqx.field(kw_only=True)

    def lower(self, x: Configuration, a: Vector) -> Vector:
        return jax.grad(self.energy, 1)(x, a)


def as_space(metric: AbstractSpace | MatrixField, manifold: AbstractManifold | None = None) -> AbstractSpace:
    """A space from a metric: a plain callable `q -> (n, n)` gets the derived operations; a space is returned as it is.

    With a `manifold` the metric is put on that manifold, such as coordinates some of which are circles. Raises
    `ValueError` for a metric that is not in coordinates.
    """
    if not isinstance(metric, AbstractSpace):
        return Metric(metric, manifold=manifold or Coordinates())
    if manifold is None:
        return metric
    if not metric.manifold.commuting:
        raise ValueError(f"the metric is on {metric.manifold}, not in coordinates; build a MechanicalSystem on it")
    return dataclasses.replace(metric, manifold=manifold)
