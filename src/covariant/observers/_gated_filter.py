"""Filters that know their own covariance: what one expects of a measurement, its gate, its correction, its new start.

The order of a correction is the same for all of them, and stands here: expect the measurement, let the gate judge what
was measured, use the rest, start anew where the gate has refused for too long, and report.
"""

import abc
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._typing import Code, Flag, Matrix, Vector
from covariant.geometry import AbstractManifold
from covariant.models import MechanicalSystem, Motion
from covariant.observers._gate import Gate, Judged, judged
from covariant.observers._protocol import AbstractObserver, outcome, uniqueness


class Expectation(NamedTuple):
    """A measurement beside what a filter expects of it.

    Attributes:
        y: The measurement, without the offset that the filter knows it to have.
        innovation: Difference (n,) from what is expected to the measurement, 0 where it is missing.
        cov: Its covariance (n, n), with the noise of the measurement.
        present: Which entries (n,) are measured.
        lost: Whether the estimate is too uncertain to be corrected, so that it starts anew whatever the gate says.
        details: What the filter has computed on the way and needs in `_used`.
    """

    y: Array
    innovation: Vector
    cov: Matrix
    present: Bool[Array, "n"]
    lost: Flag | bool = False
    details: Any = None


class AbstractGatedFilter(AbstractObserver):
    """A filter whose state has the fields `refused` and `scale` (n,), which its gate remembers."""

    gate: eqx.AbstractVar[Gate | None]

    @final
    def correct(self, state: Any, u: Float[Array, "m"], y: Array) -> tuple[Any, Any]:
        """Correct by the measurement y. Missing entries (NaN) are left out; on a group one NaN makes all missing."""
        expected = self._expected(state, u, y)
        verdict = judged(
            self.gate,
            self._manifold,
            expected.innovation,
            expected.cov,
            expected.present,
            state.refused,
            state.scale,
        )
        restart = verdict.restart | expected.lost
        corrected = self._used(state, y, expected, expected.present & ~verdict.far)
        corrected = corrected._replace(refused=verdict.refused, scale=verdict.scale)
        fresh = self._started_anew(state, corrected, y, expected)._replace(refused=jnp.zeros_like(verdict.refused))
        new = jax.tree.map(lambda a, b: jnp.where(restart, a, b), fresh, corrected)
        result = self._result(state, new, y, expected, verdict._replace(restart=restart))
        return new, self._info(state, new, expected, result)

    @final
    def innovation(self, state: Any, u: Float[Array, "m"], y: Array) -> Vector:
        return self._expected(state, u, y).innovation

    @property
    @abc.abstractmethod
    def _manifold(self) -> AbstractManifold:
        """What is measured, which says which of its entries are measured together."""

    @abc.abstractmethod
    def _expected(self, state: Any, u: Float[Array, "m"], y: Array) -> Expectation:
        """The measurement beside what is expected of it."""

    @abc.abstractmethod
    def _used(self, state: Any, y: Array, expected: Expectation, used: Bool[Array, "n"]) -> Any:
        """The state after a correction by the entries of the measurement that are `used` (n,)."""

    @abc.abstractmethod
    def _started_anew(self, state: Any, corrected: Any, y: Array, expected: Expectation) -> Any:
        """The state of a new start from the measurement, with the predicted velocity."""

    @abc.abstractmethod
    def _result(self, state: Any, new: Any, y: Array, expected: Expectation, verdict: Judged) -> Code:
        """The result code of a correction, given the verdict of the gate."""

    @abc.abstractmethod
    def _info(self, state: Any, new: Any, expected: Expectation, result: Code) -> Any:
        """The info of a correction from the predicted to the new state."""


class AbstractMechanicalFilter(AbstractGatedFilter):
    """A filter of a `MechanicalSystem` whose state holds its estimate as q and v."""

    model: eqx.AbstractVar[MechanicalSystem]

    @property
    def _manifold(self) -> AbstractManifold:
        return self.model.manifold

    def estimate(self, state: Any) -> Any:
        return self.model.state(Motion(state.q, state.v))

    def _result(self, state: Any, new: Any, y: Array, expected: Expectation, verdict: Judged) -> Code:
        return outcome(new.q, new.v, y, verdict.result(uniqueness(self.model, state.q, expected.y)))
