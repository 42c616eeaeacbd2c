"""Defines the system of a statement about contraction: a flow and a metric as functions of variables in a box."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from covariant._typing import Matrix, Scalar, Vector
from covariant.certificates.base._box import first_velocity
from covariant.certificates.base._contraction import StateMetric
from scalargraph import Lowered, lower
from scalargraph.errors import InputError
from scalargraph.proofs import Box, graph_rows


def _empty() -> Matrix:
    return jnp.zeros((0, 0))


class Point(NamedTuple):
    """The system at one point z of a region.

    Attributes:
        flow: `(t, x (2n,)) -> x' (2n,)`, with the measurement held constant.
        metric: the metric on states.
        x: the state (2n,) at z.
        error_jacobian: `() -> (2n, 2n)`: changes of position error and velocity along the vectors of the metric's
            frame; for intrinsic observers only.
        noise_jacobian: `() -> (n, n)`: change of the position error by an error of the measurement; for intrinsic
            observers only.
        corrected: `x (2n,) -> x (2n,)`: the correction by a measurement, which is held constant; like `after`, only
            for observers with samples.
        after: the metric on states right after a correction.
        missing: `x (2n,) -> (n,)`: the acceleration that a prediction omits; for observers with samples.
        inertias: `x (2n,) -> (n, n), (n, n)`: the metric at the estimated and at the measured configuration; for
            observers with samples.
    """

    flow: Callable[[Scalar, Vector], Array]
    metric: StateMetric
    x: Vector
    error_jacobian: Callable[[], Matrix] = _empty
    noise_jacobian: Callable[[], Matrix] = _empty
    corrected: Callable[[Vector], Array] | None = None
    after: StateMetric | None = None
    missing: Callable[[Vector], Array] = lambda x: x
    inertias: Callable[[Vector], tuple[Array, Array]] = lambda x: (x, x)

    @property
    def sampled(self) -> tuple[Callable[[Vector], Array], StateMetric]:
        """The correction of an observer with samples, and the metric after it."""
        assert self.corrected is not None
        assert self.after is not None
        return self.corrected, self.after


class ErrorSystem(NamedTuple):
    """A dynamic system and a metric on a box of variables, as needed for a proof of contraction.

    Attributes:
        names: names of the variables (d). For an intrinsic observer these are, n each: the estimated position (not on a
            group), the estimated velocity, the error of the position, and the force on the system; then friction and
            its slopes, if friction is a variable too, or time and inputs as far as the friction depends on them.
        units: their units.
        at: `z (d,) -> Point`: flow, metric and state at a point z of the box.
        at_rest: the same with a constant measurement, if `at` allows one that changes with time; otherwise None. Each
            instant is then the first instant at another z. Nothing else may depend on time.
        has_samples: whether measurements are sampled, so that points have a correction.
        driven: places among (time, inputs) of the last variables, on which the friction depends.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> from covariant.certificates import error_system
        >>> system = error_system(observers.Intrinsic(models.oscillator(), 2.0, 2.0), np.eye(2))
        >>> system.names, system.units
        (('q', 'v_q', 'e_q', 'f_q'), ('m', 'm/s', 'm', ''))
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    at: Callable[[Vector], Point]
    at_rest: Callable[[Vector], Point] | None = None
    has_samples: bool = False
    driven: tuple[int, ...] = ()

    def first_velocity(self, n: int) -> int:
        """Place of the first velocity among the variables of an intrinsic observer.

        Args:
            n: number of velocities.
        """
        return first_velocity(len(self.names) - len(self.driven), n, self.has_samples)

    def errors(self, n: int) -> range:
        """Places of the position errors among the variables of a system with samples.

        Args:
            n: number of velocities.
        """
        # After them come three kinds of forces and slopes, and the age.
        first = len(self.names) - 4 * n - 1
        return range(first, first + n)


def entries_read(function, *arguments: Array) -> set[int]:
    """Determine the entries of its arguments on which a function depends."""
    return inputs_of(lower(function, *arguments, real=True))


def inputs_of(lowered: Lowered) -> set[int]:
    """Determine the inputs that the graph of a real function reads, in values or in conditions."""
    assert lowered.conditions is not None
    # Inputs of conditions count as read, since they may decide where the function is defined.
    graphs = lowered.graph, lowered.conditions.graph
    return {int(node.value or 0) for graph in graphs for node in graph.nodes if node.op == "input"}


def need_steady(what: str, error_system: ErrorSystem, domain: Box) -> None:
    """Check that flow and metric do not depend on time."""
    # The golden section of every interval is used: at a midpoint, terms could vanish by symmetry.
    point = (error_system.at_rest or error_system.at)(jnp.asarray(0.618 * domain.low + 0.382 * domain.high))
    x, metric = point.x, point.metric

    def parts(t):
        pieces = point.flow(t, x), metric.coframe(t, x), metric.frame(t, x), metric.gram(t, x)
        return jnp.concatenate([jnp.ravel(part) for part in pieces])

    if entries_read(parts, jnp.zeros(())):
        raise InputError(
            f"{what}: the flow or the metric depends on time, and the statement would be about one instant; make time "
            "a variable of the box, or leave it out"
        )


def values(error_system: ErrorSystem) -> Callable[[Scalar, Vector, Vector], tuple[Array, ...]]:
    """Collect the functions from which all claims are formed, with their derivatives."""

    def at(t, x, z):
        point = error_system.at(z)
        metric = point.metric
        parts = point.flow(t, x), metric.coframe(t, x), metric.frame(t, x), metric.gram(t, x)
        return *parts, point.error_jacobian(), point.noise_jacobian()

    return at


def corrections(error_system: ErrorSystem) -> Callable[[Scalar, Vector, Vector], tuple[Array, ...]]:
    """Collect the functions from which claims about the correction are formed, with their derivatives."""

    def at(t, x, z):
        point = error_system.at(z)
        corrected, after = point.sampled
        before, new = point.metric, corrected(x)
        now = jnp.zeros_like(t)
        frames = after.coframe(now, new), after.gram(now, new), before.frame(t, x), before.gram(t, x)
        return new, *frames, point.missing(x), *point.inertias(x)

    return at


def value_graph(about: ErrorSystem) -> dict[str, list]:
    """Convert the functions on which the claims depend to a graph of scalars, for readers without JAX."""
    d = len(about.names)
    states = jax.eval_shape(lambda z: about.at(z).x, jnp.zeros(d)).shape[0]
    sampled = about.has_samples

    def everything(t, x, z):
        return (*values(about)(t, x, z), *(corrections(about)(t, x, z) if sampled else ()))

    lowered = lower(everything, jnp.zeros(()), jnp.zeros(states), jnp.zeros(d), real=True)
    return graph_rows(lowered)
