"""Filters with a covariance: expected measurement, gate, correction and new start, in the same order for all of them.

A correction computes the expected measurement and its covariance, lets the gate judge the innovation, uses what passes,
starts anew where the gate has refused for too long, and reports. A filter supplies these parts; the order is here.

The same parts show a smoother what a step did to the error (N,): `carried` where the prediction takes a square root of
its covariance, `corrected` the correction and the reset. `root`, `with_root`, `moved` and `deviations` read and write a
state by its error, whatever its fields are.
"""

import abc
from typing import Any, NamedTuple, Protocol, TypeVar, final, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._linalg import solve_square
from covariant._typing import Code, Flag, Matrix, Scalar, Vector
from covariant.geometry import AbstractManifold
from covariant.models import MechanicalSystem, Motion
from covariant.observers.base import (
    AbstractObserver,
    Fields,
    Gate,
    GateMemory,
    Judged,
    Report,
    Sample,
    Velocity,
    judged,
    outcome,
    start,
    uniqueness,
)


class Expectation(NamedTuple):
    """A measurement together with a filter's prediction of it.

    Attributes:
        y: The measurement, without the offset that the filter estimates it to have.
        innovation: Difference (n,) from the prediction to the measurement, 0 where it is missing.
        cov: Covariance (n, n) of the innovation, the noise of the measurement included.
        noise: Covariance (n, n) of that noise.
        present: Which entries (n,) are measured.
        lost: Whether the estimate is too uncertain to be corrected, so that it starts anew regardless of the gate;
            False by default.
        details: Intermediate results of the filter that `_used` needs; None by default.
    """

    y: Array
    innovation: Vector
    cov: Matrix
    noise: Matrix
    present: Bool[Array, "n"]
    lost: Flag | bool = False
    details: Any = None

    def of(self, taken: Bool[Array, "n"]) -> "Expectation":
        """The same of those entries (n,) of the measurement only that are `taken`; the others count as missing."""
        return self._replace(present=taken, innovation=jnp.where(taken, self.innovation, 0.0))


@runtime_checkable
class GatedFields(Fields, Protocol):
    """The state of a filter with a gate."""

    @property
    def gate(self) -> GateMemory: ...


State = TypeVar("State", bound=GatedFields)


class Moved(NamedTuple):
    """A state after its estimate was moved by an error.

    Attributes:
        state: The state at the moved estimate; its covariance is that of before.
        reset: Derivative 𝒥 (N, N) of the error as it is seen from there in the error as it was seen before: the
            covariance at the moved estimate is 𝒥P𝒥ᵀ.
    """

    state: Any
    reset: Float[Array, "N N"]


class Used(NamedTuple):
    """A correction by the entries of a measurement that are used.

    Attributes:
        state: The corrected state.
        error: Mean δ (N,) of the error after the measurement, by which the estimate was moved.
        reset: The reset 𝒥 (N, N) of this move.
    """

    state: Any
    error: Float[Array, "N"]
    reset: Float[Array, "N N"]


class Corrected(NamedTuple):
    """A correction as a smoother needs it.

    Attributes:
        state: The corrected state, or the one of a new start.
        info: The info.
        used: The correction by what passed the gate.
        restarted: Whether the estimate started anew, so that `used` was dropped.
    """

    state: Any
    info: Any
    used: Used
    restarted: Flag


class AbstractGatedFilter(AbstractObserver[State, Report]):
    """A filter with a covariance and a gate.

    Its field `gate` is a `Gate`, or None to use every measurement. Its state has the field `gate`, a `GateMemory`,
    which its `_predicted` has to advance.
    """

    @final
    def predict(self, state: State, u: Float[Array, "m"], dt: Scalar) -> State:
        """Integrate the model and the covariance over one step."""
        return self._predicted(state, u, dt, carry=False)[0]

    @final
    def carried(self, state: State, u: Float[Array, "m"], dt: Scalar) -> tuple[State, Float[Array, "N N"]]:
        """Predict, and show where the transition Φ takes the square root S of the covariance before."""
        return self._predicted(state, u, dt, carry=True)

    @final
    def correct(self, state: State, u: Float[Array, "m"], y: Array) -> tuple[State, Report]:
        """Correct a predicted state by a measurement that passes the gate."""
        state, info, *_ = self.corrected(state, u, y)
        return state, info

    @final
    def corrected(self, state: State, u: Float[Array, "m"], y: Array) -> Corrected:
        """Correct as `correct` does, and show the correction and the reset."""
        gate: Gate | None = self.gate
        expected = self._expected(state, u, y)
        sample = Sample(expected.innovation, expected.cov, expected.noise, expected.present)
        predicted, usual = self._velocity(state), self._usual_velocity(state)
        verdict = judged(gate, self._manifold, sample, state.gate, predicted, usual)
        restart, used = verdict.restart | expected.lost, expected.present & ~verdict.far
        step = self._used(state, y, expected, used)
        corrected = step.state
        # An outlier of another joint is no place to start from; an estimate that is lost tells no outliers.
        memory, anew = verdict.memory, verdict.anew | expected.lost
        if gate is not None:
            # A new start leaves nothing behind of what it takes.
            left = jnp.where(restart, 0.0, self._expected(corrected, u, y).innovation)
            memory = memory.used(anew, left)
        corrected = self._rescaled(state, step, restart, corrected._replace(gate=memory))
        velocity = verdict.velocity
        if usual is not None:  # an estimate that is too uncertain tells nothing of its velocity but the mean
            velocity = velocity._replace(cov=jnp.where(expected.lost, usual, velocity.cov))
        # Both branches are computed, so that the program has no branch.
        fresh = self._started_anew(state, corrected, y, expected.of(anew), velocity)
        new = jax.tree.map(lambda a, b: jnp.where(restart, a, b), fresh, corrected)
        result = self._result(state, new, y, expected, verdict._replace(restart=restart))
        return Corrected(new, self._info(state, new, expected, result), step, restart)

    @final
    def innovation(self, state: State, u: Float[Array, "m"], y: Array) -> Vector:
        return self._expected(state, u, y).innovation

    def _rescaled(self, state: State, step: Used, restart: Flag, corrected: State) -> State:
        """The corrected state, with what a predicted state and its correction show of the size of the unknown."""
        return corrected

    @abc.abstractmethod
    def root(self, state: State) -> Float[Array, "N N"]:
        """Square root S (N, N) of the covariance S Sᵀ of the error of a state."""

    def regular_root(self, state: State) -> Float[Array, "N K"]:
        """A root of the covariance of a state, on a leaf with as much across it: of no effect, and regular."""
        return self.root(state)

    @abc.abstractmethod
    def with_root(self, state: State, root: Float[Array, "N N"]) -> State:
        """The state with the covariance of another square root."""

    @abc.abstractmethod
    def moved(self, state: State, error: Float[Array, "N"]) -> Moved:
        """Move the estimate of a state by an error, as a correction does."""

    @abc.abstractmethod
    def deviations(self, state: State) -> dict[str, Vector]:
        """The fields of an info that follow from a corrected state: standard deviations, and slow states."""

    @abc.abstractmethod
    def _predicted(self, state: State, u: Float[Array, "m"], dt: Scalar, carry: bool) -> tuple[State, Any]:
        """The state after a prediction and, where `carry` asks for it, ΦS (N, N) as in `carried`; otherwise None."""

    @property
    @abc.abstractmethod
    def _manifold(self) -> AbstractManifold:
        """Manifold of the measurements, which says which of their entries are measured together."""

    @abc.abstractmethod
    def _expected(self, state: State, u: Float[Array, "m"], y: Array) -> Expectation:
        """The measurement together with the filter's prediction of it."""

    @abc.abstractmethod
    def _used(self, state: State, y: Array, expected: Expectation, used: Bool[Array, "n"]) -> Used:
        """A correction by the entries of the measurement that are `used` (n,)."""

    @abc.abstractmethod
    def _velocity(self, state: State) -> Velocity:
        """The predicted velocity; what its mean has no entries for, a state-space model, may return anything."""

    @abc.abstractmethod
    def _usual_velocity(self, state: State) -> Matrix | None:
        """Covariance (n, n) of the velocity at the start, about zero; None where the state has no velocity."""

    @abc.abstractmethod
    def _started_anew(
        self, state: State, corrected: State, y: Array, expected: Expectation, velocity: Velocity
    ) -> State:
        """The state of a new start from the entries of `expected.y` that are `expected.present`, with this velocity.

        The other entries stay where they are predicted, as uncertain as there. The raw form of the measurement is y.
        """

    @abc.abstractmethod
    def _result(self, state: State, new: State, y: Array, expected: Expectation, verdict: Judged) -> Code:
        """The result code of a correction, given the verdict of the gate."""

    @abc.abstractmethod
    def _info(self, state: State, new: State, expected: Expectation, result: Code) -> Report:
        """The info of a correction from the predicted to the new state."""


class AbstractMechanicalFilter(AbstractGatedFilter):
    """A filter with a gate for a `MechanicalSystem`, whose state holds the estimate in its fields q and v.

    Attributes:
        model: The mechanical system.
    """

    model: eqx.AbstractVar[MechanicalSystem]

    @property
    def _manifold(self) -> AbstractManifold:
        return self.model.manifold

    def estimate(self, state: Any) -> Any:
        return self.model.state(Motion(state.q, state.v))

    def _rescaled(self, state: Any, step: Used, restart: Flag, corrected: Any) -> Any:
        if state.noise_scale is None:
            return corrected
        # The covariance after the correction and before the reset.
        after = solve_square(step.reset, self.root(step.state))
        scale = state.noise_scale.corrected(
            self.root(state), after, step.error, step.reset, restart, jnp.mean(state.gate.scale)
        )
        return corrected._replace(noise_scale=scale)

    def _start(self, state: Any, expected: Expectation) -> Array:
        """The configuration of a new start: measured where entries of the measurement are present, else predicted."""
        return start(self.model.manifold, state.q, expected.innovation, expected.y, expected.present)

    def _result(self, state: Any, new: Any, y: Array, expected: Expectation, verdict: Judged) -> Code:
        return verdict.result(
            outcome(new.q, new.v, self._manifold.seen(state.q, y), uniqueness(self.model, state.q, expected.y))
        )
