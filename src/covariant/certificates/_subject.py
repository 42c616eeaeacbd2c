"""The subject of a statement about contraction: a flow and a metric, as functions of variables in a box."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from covariant._typing import Matrix, Scalar, Vector
from covariant.certificates._contraction import StateMetric
from covariant.lowering import lower
from covariant.proofs import Box


def _nothing() -> Matrix:
    return jnp.zeros((0, 0))


class Point(NamedTuple):
    """A point z of a region: the flow with the measurement held constant, the metric, and a state x (2n,).

    Two Jacobians are defined for intrinsic observers only:

    - `error_jacobian()` (2n, 2n): changes of position error and velocity by the vectors of the metric's frame.
    - `noise_jacobian()` (n, n): change of the position error by an error of the measurement.
    """

    flow: Callable[[Scalar, Vector], Array]
    metric: StateMetric
    x: Vector
    error_jacobian: Callable[[], Matrix] = _nothing
    noise_jacobian: Callable[[], Matrix] = _nothing


class Subject(NamedTuple):
    """A system about which something is proved on a region, which is a box of variables.

    - `names`, `units`: of the variables. For an intrinsic observer these are, n each, the estimated position (not on a
      group) and velocity, the error of the position, and the force on the system.
    - `at`: the `Point` at a point z of the box.
    - `at_rest`: the same with a measurement that does not move, where one moves with time: then each instant is the
      first one at another z. Nothing else may depend on time.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    at: Callable[[Vector], Point]
    at_rest: Callable[[Vector], Point] | None = None


def entries_read(function, *arguments: Array) -> set[int]:
    """The entries of its arguments, numbered consecutively, on which a function or its domain depends."""
    lowered = lower(function, *arguments, real=True)
    assert lowered.conditions is not None
    graphs = lowered.graph, lowered.conditions.graph
    return {int(node.value or 0) for graph in graphs for node in graph.nodes if node.op == "input"}


def need_steady(what: str, subject: Subject, domain: Box) -> None:
    """Raise `ValueError` for a flow or a metric that depends on time, where a statement looks at one instant only."""
    # At the golden section of every variable nothing vanishes by chance.
    point = (subject.at_rest or subject.at)(jnp.asarray(0.618 * domain.low + 0.382 * domain.high))
    x, metric = point.x, point.metric

    def parts(t):
        shown = point.flow(t, x), metric.coframe(t, x), metric.frame(t, x), metric.gram(t, x)
        return jnp.concatenate([jnp.ravel(part) for part in shown])

    if entries_read(parts, jnp.zeros(())):
        raise ValueError(
            f"{what}: the flow or the metric depends on time, and the statement would be about one instant; make time "
            "a variable of the box, or leave it out"
        )


def values(subject: Subject) -> Callable[[Scalar, Vector, Vector], tuple[Array, ...]]:
    """The functions from which, with their derivatives, all claims are made: flow, Θ, Θ⁻¹, N and both Jacobians."""

    def at(t, x, z):
        point = subject.at(z)
        metric = point.metric
        parts = point.flow(t, x), metric.coframe(t, x), metric.frame(t, x), metric.gram(t, x)
        return *parts, point.error_jacobian(), point.noise_jacobian()

    return at
