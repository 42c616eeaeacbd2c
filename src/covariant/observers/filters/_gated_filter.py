"""Defines filters with a covariance and a gate: expected measurement, gate, correction, restart, always in this order.

A correction computes the expected measurement and its covariance, lets the gate judge the innovation, uses the entries
that pass, restarts if the gate has refused for too long, and reports. A filter supplies these parts; their order is
defined here. The same parts show a smoother the effect of a step on the error (N,): `carried` for the prediction,
applied to a square root of the covariance, and `corrected` for the correction and the reset. `root`, `with_root`,
`moved` and `deviations` read and write a state by its error, whatever fields it has.
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
        y: The measurement, without its estimated offset.
        innovation: Difference (n,) from the prediction to the measurement, 0 where it is missing.
        cov: Covariance (n, n) of the innovation, the noise of the measurement included.
        noise: Covariance (n, n) of that noise.
        present: Which entries (n,) are measured.
        lost: Whether the estimate is too uncertain to be corrected, so that it restarts regardless of the gate; False
            by default.
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
        """The same for the entries (n,) of the measurement that are `taken`; the others count as missing."""
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
        state: The state at the moved estimate, with the covariance from before.
        reset: Derivative 𝒥 (N, N) of the error as seen from the moved estimate, with respect to the error as seen
            before: the covariance at the moved estimate is 𝒥P𝒥ᵀ.
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
    """A correction in the form that a smoother needs.

    Attributes:
        state: The corrected state, or the state of a restart.
        info: The info.
        used: The correction by the entries that passed the gate.
        restarted: Whether the estimate restarted, so that `used` was dropped.
    """

    state: Any
    info: Any
    used: Used
    restarted: Flag


class AbstractGatedFilter(AbstractObserver[State, Report]):
    """A filter with a covariance and a gate.

    Its field `gate` is a `Gate`, or None to use every measurement. Its state also has a field `gate`, a `GateMemory`,
    which `_predicted` must advance.
    """

    @final
    def predict(self, state: State, u: Float[Array, "m"], dt: Scalar) -> State:
        """Integrate the model and the covariance over one step."""
        return self._predicted(state, u, dt, carry=False)[0]

    @final
    def carried(self, state: State, u: Float[Array, "m"], dt: Scalar) -> tuple[State, Float[Array, "N N"]]:
        """Predict, and return the product ΦS of the transition Φ with the square root S of the covariance before."""
        return self._predicted(state, u, dt, carry=True)

    @final
    def correct(self, state: State, u: Float[Array, "m"], y: Array) -> tuple[State, Report]:
        """Correct a predicted state by a measurement that passes the gate."""
        state, info, *_ = self.corrected(state, u, y)
        return state, info

    @final
    def corrected(self, state: State, u: Float[Array, "m"], y: Array) -> Corrected:
        """Correct as `correct` does, and also return the correction and the reset."""
        # If this class had a field `gate`, it would precede the fields of a filter and change the order of arguments.
        gate: Gate | None = self.gate
        expected = self._expected(state, u, y)
        sample = Sample(expected.innovation, expected.cov, expected.noise, expected.present)
        predicted, usual = self._velocity(state), self._usual_velocity(state)
        verdict = judged(gate, self._manifold, sample, state.gate, predicted, usual)
        restart, used = verdict.restart | expected.lost, expected.present & ~verdict.far
        step = self._used(state, y, expected, used)
        corrected = step.state
        # Never restart from the outlier of another joint. A lost estimate cannot classify outliers.
        memory, anew = verdict.memory, verdict.anew | expected.lost
        if gate is not None:
            # Nothing is left over of entries from which the estimate restarts.
            left = jnp.where(restart, 0.0, self._expected(corrected, u, y).innovation)
            memory = memory.used(anew, left)
        corrected = self._rescaled(state, step, restart, corrected._replace(gate=memory))
        velocity = verdict.velocity
        if usual is not None:  # of the velocity of an estimate that is too uncertain, only the mean is used
            velocity = velocity._replace(cov=jnp.where(expected.lost, usual, velocity.cov))
        # Both cases are computed, so that the program has no branch.
        fresh = self._started_anew(state, corrected, y, expected.of(anew), velocity)
        new = jax.tree.map(lambda a, b: jnp.where(restart, a, b), fresh, corrected)
        result = self._result(state, new, y, expected, verdict._replace(restart=restart))
        return Corrected(new, self._info(state, new, expected, result), step, restart)

    @final
    def innovation(self, state: State, u: Float[Array, "m"], y: Array) -> Vector:
        return self._expected(state, u, y).innovation

    @final
    def seen(self, state: State, u: Float[Array, "m"], y: Array) -> tuple[Vector, Float[Array, "n N"], Matrix]:
        """Innovation (n,) of a measurement, its derivative with respect to the error, and covariance of its noise."""

        def innovation(error):
            return self.innovation(self.moved(state, error).state, u, y)

        expected = self._expected(state, u, y)
        slope = jax.jacfwd(innovation)(jnp.zeros_like(self.root(state)[0]))
        return expected.innovation, slope, expected.noise

    @final
    def reading(
        self, predicted: State, corrected: State, u: Float[Array, "m"], y: Array
    ) -> tuple[Bool[Array, "n"], Vector, Vector]:
        """Which entries of a measurement were used, and standard deviations (n,) of its innovation and its noise."""
        expected = self._expected(predicted, u, y)
        variances = jnp.diag(expected.cov), jnp.diag(expected.noise)
        return expected.present & (corrected.gate.refused == 0), jnp.sqrt(variances[0]), jnp.sqrt(variances[1])

    @property
    def turning(self) -> tuple[int, ...]:
        """Indices of the entries of an innovation that are angles on a full circle."""
        return self.circles or tuple(i for i, *others in self._manifold.rotations or () if not others)

    def _rescaled(self, state: State, step: Used, restart: Flag, corrected: State) -> State:
        """The corrected state, with the noise size that prediction and correction suggest if the filter adapts."""
        return corrected

    @abc.abstractmethod
    def root(self, state: State) -> Float[Array, "N N"]:
        """Square root S (N, N) of the covariance S Sᵀ of the error of a state."""

    def regular_root(self, state: State) -> Float[Array, "N K"]:
        """A root of the covariance of a state; on a leaf a normal part makes it regular, without any effect."""
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
        """The state after a prediction and, if `carry` is set, ΦS (N, N) as in `carried`; otherwise None."""

    @property
    @abc.abstractmethod
    def _manifold(self) -> AbstractManifold:
        """Manifold of the measurements; it says which of their entries are measured together."""

    @abc.abstractmethod
    def _expected(self, state: State, u: Float[Array, "m"], y: Array) -> Expectation:
        """The measurement together with the filter's prediction of it."""

    @abc.abstractmethod
    def _used(self, state: State, y: Array, expected: Expectation, used: Bool[Array, "n"]) -> Used:
        """A correction by the entries of the measurement that are `used` (n,)."""

    @abc.abstractmethod
    def _velocity(self, state: State) -> Velocity:
        """The predicted velocity; for a state-space model, whose mean contains no velocity, any value."""

    @abc.abstractmethod
    def _usual_velocity(self, state: State) -> Matrix | None:
        """Covariance (n, n) of the velocity at the start, about zero; None if the state has no velocity."""

    @abc.abstractmethod
    def _started_anew(
        self, state: State, corrected: State, y: Array, expected: Expectation, velocity: Velocity
    ) -> State:
        """The state after a restart from the entries of `expected.y` that are `expected.present`, with this velocity.

        The other entries stay as predicted, with their uncertainty. The raw form of the measurement is y.
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
        # The covariance after the correction, but before the reset.
        after = solve_square(step.reset, self.root(step.state))
        before, size = self.root(state), jnp.mean(state.gate.scale)
        scale = state.noise_scale.corrected(before, after, step.error, step.reset, restart, size)
        return corrected._replace(noise_scale=scale)

    def cov(self, state: Any) -> Float[Array, "N N"]:
        """Covariance (N, N) of the errors of the estimate."""
        return state.root @ state.root.T

    def root(self, state: Any) -> Float[Array, "N N"]:
        return state.root

    def with_root(self, state: Any, root: Float[Array, "N N"]) -> Any:
        return state._replace(root=root)

    def _velocity(self, state: Any) -> Velocity:
        n = state.v.shape[0]
        root = state.root[n : 2 * n]
        return Velocity(state.v, root @ root.T)

    def _start(self, state: Any, expected: Expectation) -> Array:
        """The configuration of a restart: the measured entries, and the predicted ones in place of missing ones."""
        return start(self.model.manifold, state.q, expected.innovation, expected.y, expected.present)

    def _result(self, state: Any, new: Any, y: Array, expected: Expectation, verdict: Judged) -> Code:
        code = uniqueness(self.model, state.q, expected.y)
        return verdict.result(outcome(new.q, new.v, self._manifold.seen(state.q, y), code))
