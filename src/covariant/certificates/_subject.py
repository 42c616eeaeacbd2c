"""What a statement about contraction is made of: a flow and a metric, as functions of boxed variables."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from covariant._typing import Matrix, Scalar, Vector
from covariant.certificates._contraction import StateMetric


def _nothing() -> Matrix:
    return jnp.zeros((0, 0))


class Point(NamedTuple):
    """What a point z of a region stands for: the flow with the measurement held, the metric, and a state x (2n,).

    Of intrinsic observers, `error_jacobian()` (2n, 2n): the changes of position error and velocity that the vectors of
    the metric's frame bring; `noise_jacobian()` (n, n): the change of the position error that an error of the
    measurement brings.
    """

    flow: Callable[[Scalar, Vector], Array]
    metric: StateMetric
    x: Vector
    error_jacobian: Callable[[], Matrix] = _nothing
    noise_jacobian: Callable[[], Matrix] = _nothing


class Subject(NamedTuple):
    """A system about which something is proved on a region, which is a box of variables.

    - `names`, `units`: of the variables. Of an intrinsic observer these are, n each, the estimate's position (not on a
      group) and velocity, the error of its position, and the force on the system.
    - `at`: what a point z of the box stands for.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    at: Callable[[Vector], Point]


def values(subject: Subject) -> Callable[[Scalar, Vector, Vector], tuple[Array, ...]]:
    """All that is claimed of a subject is made of this and its derivatives: flow, Θ, Θ⁻¹, N and both Jacobians."""

    def at(t, x, z):
        point = subject.at(z)
        metric = point.metric
        parts = point.flow(t, x), metric.coframe(t, x), metric.frame(t, x), metric.gram(t, x)
        return *parts, point.error_jacobian(), point.noise_jacobian()

    return at
