"""Defines the protocol that all observers share, and the loop that drives them.

An observer is a frozen recipe: it contains its settings and never changes. Its state is everything that it remembers
from sample to sample, and the caller keeps it. Its info contains the diagnostics of one step. A loop by hand:

    state = observer.init(y[0], t[0])
    for k in range(1, len(t)):
        state, info = observer.step(state, u[k - 1], y[k], t[k] - t[k - 1])
        x = observer.estimate(state)

A step has two halves, which an observer defines and a caller may also call separately: `predict` moves the state to the
time of a measurement, `correct` corrects it there. The methods of the protocol, from the inside out:

- `predict(state, u, dt)` runs the model over dt under the constant input u, without a measurement.
- `correct(state, u, y)` corrects a predicted state by a measurement y taken at its own time; no time passes.
- `innovation(state, u, y)` is the innovation that `correct` reports for the same arguments, without a correction.
- `advance(state, u, y, dt)` is `correct` after `predict`, for valid numbers.
- `step(state, u, y, dt)` is `advance` for any numbers: it replaces invalid ones, and reports that it did.

Wrappers of an observer, such as a gate or a buffer for late sensors, use `predict` and `correct`.
"""

import abc
import math
from collections.abc import Collection
from functools import partial
from typing import Any, Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Inexact

from covariant._domains import FINITE_ENTRIES, NOT_NEGATIVE, POSITIVE, Domain
from covariant._functional import Functional
from covariant._typing import Code, Flag, Number, Numbers, Scalar, Vector
from covariant.geometry import AbstractManifold
from covariant.models import MechanicalSystem, Motion, StateSpace, input_count
from covariant.observers.base._restart import all_finite, started
from covariant.observers.base._states import Fields, LastInput, Report, SampledState, State
from covariant.signals import AnyArray, Record, Run, StepCode, check_rounding, largest_measurement
from scalargraph.errors import InputError


def _is_number(x: object) -> bool:
    return isinstance(x, int | float) or (isinstance(x, Array) and x.ndim == 0)


class AbstractObserver(Functional, Generic[State, Report]):
    """Estimates the state of a system from measured positions, sample by sample.

    A subclass writes its algorithm in `init`, `predict`, `correct` and `estimate`. `predict` and `correct` receive
    valid numbers only: `step`, the same for all observers, replaces invalid ones before it calls them. A state is a
    `NamedTuple` of arrays whose form never changes. If it has a field `last_input` with the shape of the input, `step`
    stores the last finite input there.

    Example:
        A filter that halves its error with each sample, and expects the position to stay where it is:

        >>> from typing import NamedTuple
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from covariant import StepCode, observers
        >>> class Position(NamedTuple):
        ...     q: jax.Array
        >>> class Halving(observers.AbstractObserver):
        ...     def init(self, y, t=0.0):
        ...         return Position(y)
        ...     def predict(self, state, u, dt):
        ...         return state
        ...     def correct(self, state, u, y):
        ...         missing = jnp.isnan(y)
        ...         innovation = jnp.where(missing, 0.0, y - state.q)
        ...         result = jnp.where(jnp.any(missing), int(StepCode.COASTED), int(StepCode.OK))
        ...         info = observers.Info(innovation, jnp.linalg.norm(innovation), result)
        ...         return Position(state.q + innovation / 2), info
        ...     def estimate(self, state):
        ...         return state.q
        >>> observer, no_input = Halving(), jnp.zeros(0)
        >>> state = observer.init(jnp.array([0.0]))
        >>> state, info = observer.step(state, no_input, jnp.array([8.0]), 0.1)
        >>> observer.estimate(state).tolist(), info.innovation.tolist()
        ([4.0], [8.0])
        >>> state, info = observer.step(state, no_input, jnp.array([jnp.inf]), 0.1)  # counts as missing
        >>> observer.estimate(state).tolist(), StepCode(int(info.result)).name
        ([4.0], 'COASTED')
    """

    # What a reader of any observer may ask for. Without annotations: a field here would be the first of its arguments.
    circles = tuple[int, ...]()
    sensors, slow_names = tuple[Any, ...](), tuple[str, ...]()
    gate, substeps = None, 0

    def __repr__(self) -> str:
        # `vars` instead of the fields, so that a module under construction shows the attributes it has so far.
        numbers = (f"{name}={x}" for name, x in vars(self).items() if _is_number(x))
        return f"<{type(self).__name__}: {', '.join(numbers)}>"

    @abc.abstractmethod
    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> State:
        """State at rest at a measured configuration.

        Args:
            y: First measurement, complete: coordinates (n,), or on a group a matrix (N, N).
            t: Its time stamp [s], 0 by default.

        Returns:
            The state, in the same form as all later ones.

        Raises:
            ValueError: y is not a configuration. A compiled function raises nothing and returns a state that is not
                finite.
        """

    def step(self, state: State, u: Float[Array, "m"], y: Inexact[Array, "*n"], dt: Number) -> tuple[State, Report]:
        """Predict over dt to the time of a measurement, then correct by it; invalid numbers never spoil the state.

        The step is `advance` with the replacements below, and `info.result` reports the worst of them. If the state is
        returned unchanged, the other fields of the info are those of a step of zero length without input.

        - NaN in y marks a missing measurement, over which the model predicts alone. An entry of y that is infinite or
          larger than `largest` counts as missing, and so does a matrix that is not a rotation: `COASTED`.
        - An entry of u that is not finite is replaced by the last finite one, or by 0 before there is any:
          `INPUT_HELD`.
        - For dt = 0 the state is returned unchanged: `REPEATED`. A subnormal dt, which processors may flush to zero,
          counts as zero.
        - For a dt that is negative or not finite the state is returned unchanged too: `STEP_REFUSED`.
        - A state that is `lost`, as after an input of 1e200, is replaced by a restart at the measurement if that is
          complete, and otherwise by the state before, so that every state is finite: `NOT_FINITE`.

        Subclasses do not override it, except those that make the step of another observer with another input.

        Args:
            state: State after the previous sample, from `init` or from this method.
            u: Input (m,) that acted from the previous sample to this one, held constant; (0,) for a system without
                inputs.
            y: Measurement at the end of the step: coordinates (n,), or on a group a matrix (N, N).
            dt: Time from the previous sample to this one [s].

        Returns:
            The corrected state at the time of y, in the form of `state`, and the info.
        """
        dt = jnp.asarray(dt, jnp.result_type(dt, jnp.finfo(y.dtype).dtype))  # a Python number has no dtype
        advances = jnp.isfinite(dt) & (dt >= jnp.finfo(dt.dtype).tiny)
        valid_u = jnp.where(jnp.isfinite(u), u, _replacement_input(state, u))
        too_large = jnp.abs(y) > self.largest(y)
        measured = self.admitted(jnp.where(too_large, jnp.nan, y))
        # A refused step is computed with dt = 0 and u = 0, so that invalid numbers cannot affect `info.result`.
        told = _with_missing_input(state, u)
        advanced, info = self.advance(told, jnp.where(advances, valid_u, 0.0), measured, jnp.where(advances, dt, 0.0))
        # Every case is computed, so that the program has no branches.
        lost = self.lost(advanced, info)
        fresh = started(self.init, advanced, measured)
        usable = all_finite(self.estimate(fresh))

        def select(new: Array, start: Array, old: Array) -> Array:
            return jnp.where(advances, jnp.where(lost, jnp.where(usable, start, old), new), old)

        new_state = jax.tree.map(select, _with_last_input(advanced, state, valid_u), fresh, state)
        # A larger code is worse: see `StepCode`.
        fault = jnp.where(lost, int(StepCode.NOT_FINITE), _input_fault(u, too_large, dt))
        result = jnp.maximum(info.result, fault.astype(info.result.dtype))
        ran = valid_u, measured, jnp.where(advances, dt, 0.0)
        return self.reported(state, new_state, info._replace(result=result), *ran)

    def lost(self, state: State, info: Report) -> Flag:
        """Whether a state after `advance` is no longer finite, so that no later measurement can correct it.

        Args:
            state: State after the step.
            info: The info of the step.

        Returns:
            True if the step has the result `NOT_FINITE`, or the estimate is not all finite.
        """
        return (info.result == int(StepCode.NOT_FINITE)) | ~all_finite(self.estimate(state))

    def reported(
        self, before: State, after: State, info: Report, u: Float[Array, "m"], y: Inexact[Array, "*n"], dt: Scalar
    ) -> tuple[State, Report]:
        """Complete the result of `step`; a subclass may add what depends on the whole step. By default nothing changes.

        Args:
            before: State before the step.
            after: State after it.
            info: The info, with the result code of the whole step.
            u: Input (m,) that acted, with invalid entries replaced.
            y: Measurement, NaN if it counts as missing.
            dt: Length of the prediction [s], 0 if none was made.

        Returns:
            The state and the info.
        """
        return after, info

    def advance(self, state: State, u: Float[Array, "m"], y: Inexact[Array, "*n"], dt: Scalar) -> tuple[State, Report]:
        """Predict and then correct: `step` for valid numbers.

        It is `correct(predict(state, u, dt), u, y)`. A field that is None in `state` is None in the new state too. A
        subclass need not define it.

        Args:
            state: State after the previous sample.
            u: Input (m,), finite, held constant over the step.
            y: Measurement at the end of the step, finite or NaN where missing.
            dt: Length of the step [s], finite and ≥ 0.

        Returns:
            The new state and the info.
        """
        corrected, info = self.correct(self.predict(state, u, dt), u, y)
        # A field that is None in the state, such as `age` in a state written by hand, stays None in the next one.
        return corrected._replace(**{name: None for name in state._fields if getattr(state, name) is None}), info

    @abc.abstractmethod
    def predict(self, state: State, u: Float[Array, "m"], dt: Scalar) -> State:
        """Move the state dt later, without a measurement.

        Args:
            state: State after the previous sample.
            u: Input (m,), finite, held constant over dt.
            dt: Length of the prediction [s], finite and ≥ 0.

        Returns:
            The predicted state, with the data that `correct` needs about the prediction, such as its length.
        """

    @abc.abstractmethod
    def correct(self, state: State, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> tuple[State, Report]:
        """Correct a predicted state by a measurement taken at its own time; no time passes.

        Args:
            state: State that `predict` returned.
            u: Input (m,), finite, that acted over the prediction.
            y: Measurement, finite or NaN where missing. A missing entry corrects nothing, and its innovation is 0.

        Returns:
            The corrected state and the info, whose innovation is that of the predicted state.
        """

    def innovation(self, state: State, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> Vector:
        """Innovation of a measurement at a predicted state, without a correction.

        It equals `correct(state, u, y)[1].innovation`, and is computed so by default; subclasses compute it with less
        work.

        Args:
            state: State that `predict` returned.
            u: Input (m,), finite, that acted over the prediction.
            y: Measurement, finite or NaN where missing.

        Returns:
            Innovation (n,), from the predicted measurement to y, 0 if y is missing.
        """
        return self.correct(state, u, y)[1].innovation

    def largest(self, y: Inexact[Array, "*n"] | np.ndarray) -> np.ndarray:
        """Largest magnitude of each entry of a measurement; `step` treats a larger entry as missing.

        The bounds are those of `signals.largest_measurement`.

        Args:
            y: A measurement; only its shape and precision are used.

        Returns:
            The bounds, in the shape of y.
        """
        return largest_measurement(y, self.circles or (() if self.manifold is None else self.manifold.circles))

    def admitted(self, y: Inexact[Array, "*n"]) -> Inexact[Array, "*n"]:
        """Replace a measurement by NaN if it is not a configuration of the model, such as a matrix but no rotation.

        Args:
            y: Measurement: coordinates (n,), or on a group a matrix (N, N).

        Returns:
            The measurement, unchanged if it is a configuration or the observer has no model with a manifold.
        """
        return y if self.manifold is None else self.manifold.admitted(y)

    @property
    def manifold(self) -> AbstractManifold | None:
        """The manifold of the configurations of the observer's model; None where it has no model."""
        return getattr(getattr(self, "model", None), "manifold", None)

    fixed_numbers = False
    """Whether all numbers are constants in generated code, because a proof holds for these numbers only."""

    input_at_end = False
    """Whether a step gets the input at its end, as for inputs that are linear between samples, or at its begin."""

    def configuration(self, y: AnyArray) -> Any:
        """The configuration within a measurement: all of it, unless the observer has further sensors.

        Args:
            y: Measurement, an array of any type.

        Returns:
            The entries of the configuration, in its shape: coordinates (n,), or on a group a matrix (N, N).
        """
        return y

    @abc.abstractmethod
    def estimate(self, state: State) -> Any:
        """Estimate of a state.

        Args:
            state: State of this observer.

        Returns:
            x = (q, v) (2n,); a `Motion` for a system that is not in coordinates.
        """


class AbstractWrapper(AbstractObserver[State, Report]):
    """An observer that wraps another one and takes the same measurements.

    Attributes:
        observer: The inner observer.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> kalman = observers.IntrinsicKalman(models.oscillator(), 1e-3, 1e-4, 1.0)
        >>> late = observers.FixedLag(kalman, lag=3)
        >>> isinstance(late, observers.AbstractWrapper), late.sensors, late.configuration(jnp.ones(1)).tolist()
        (True, (), [1.0])
    """

    observer: eqx.AbstractVar[Any]

    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> State:
        return self.observer.init(y, t)

    def estimate(self, state: State) -> Any:
        return self.observer.estimate(state)

    def predict(self, state: State, u: Float[Array, "m"], dt: Scalar) -> State:
        return self.observer.predict(state, u, dt)

    def admitted(self, y: Inexact[Array, "*n"]) -> Inexact[Array, "*n"]:
        return self.observer.admitted(y)

    def largest(self, y: Inexact[Array, "*n"] | np.ndarray) -> np.ndarray:
        return self.observer.largest(y)

    def configuration(self, y: AnyArray) -> Any:
        return self.observer.configuration(y)

    @property
    def sensors(self) -> tuple[Any, ...]:
        """The further sensors of the inner observer, besides those of the configuration; empty if it has none."""
        return self.observer.sensors


class AbstractFlowObserver(AbstractObserver[State, Report]):
    """An observer that is defined by a differential equation, `flow`, in addition to its sampled form.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observer = observers.ModelCopy(models.oscillator(), alpha=2.0, beta=4.0)
        >>> isinstance(observer, observers.AbstractFlowObserver)
        True
        >>> state = observers.continuous(observer.init(jnp.zeros(1)))
        >>> observer.flow(state.t, state, jnp.zeros(1), jnp.array([0.5])).q.tolist()  # α times the error
        [1.0]
    """

    @abc.abstractmethod
    def flow(self, t: Scalar, state: State, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> State:
        """Time derivative of the state, for measurements in continuous time.

        Args:
            t: Time [s].
            state: State of this observer.
            u: Input (m,) at the time t.
            y: Complete measurement at the time t.

        Returns:
            The derivative, in the form of the state. Fields that are only stored between samples have the derivative
            zero.
        """


class AbstractMechanicalObserver(AbstractFlowObserver):
    """An observer of a `MechanicalSystem` whose state holds the estimate in its fields q and v.

    In the derivative that `flow` returns, the field q holds the velocity w (n,) of the estimate in the frame, with
    `q̂' = E(q̂)w`.

    Attributes:
        model: The mechanical system.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> from covariant.observers.base import AbstractMechanicalObserver
        >>> observer = observers.Intrinsic(models.ball_and_beam(), alpha=4.0, beta=8.0)
        >>> isinstance(observer, AbstractMechanicalObserver)
        True
        >>> state = observer.init(jnp.array([0.3, 0.1]))
        >>> observer.estimate(state).tolist()  # q, then v: at rest
        [0.3, 0.1, 0.0, 0.0]
    """

    model: eqx.AbstractVar[MechanicalSystem]

    def estimate(self, state: Any) -> Any:
        return self.model.state(Motion(state.q, state.v))

    def innovation(self, state: Any, u: Float[Array, "m"], y: Array) -> Vector:
        return self.model.manifold.ambient.towards(state.q, y)


def at_rest(model: MechanicalSystem, y: Array, t: Number) -> SampledState:
    """State at rest at the first measurement."""
    q = model.manifold.checked(y)
    rest = model.manifold.zero(q)
    t = jnp.asarray(t, rest.dtype)
    return SampledState(q, rest, t, no_input(model, rest), jnp.zeros_like(t))


def since(state: Any, dt: Scalar) -> Scalar:
    """Time since the last measurement at the end of a prediction."""
    return dt if state.age is None else state.age + dt


def aged(model: MechanicalSystem, state: Any, y: Array) -> Scalar:
    """Field `age` after the measurement y: 0 unless all of y is missing."""
    return state.age * jnp.all(model.manifold.missing(y)).astype(state.age.dtype)


def uniqueness(model: MechanicalSystem, q: Array, y: Array) -> Code:
    """`OK` if the shortest path from the estimate to the measurement is unique, else `CUT_LOCUS`."""
    unique = model.manifold.unique(q, model.manifold.measured(q, y))
    return jnp.where(unique, int(StepCode.OK), int(StepCode.CUT_LOCUS)).astype(jnp.int32)


def readability(model: MechanicalSystem, q: Array, y: Array) -> Code:
    """`uniqueness` for constant gains; `NOT_RECONSTRUCTIBLE` at a dead centre of the measured coordinates."""
    dead = model.manifold.dead_centre(q, y)
    return jnp.where(dead, int(StepCode.NOT_RECONSTRUCTIBLE), uniqueness(model, q, y)).astype(jnp.int32)


def as_gain(value: object) -> Any:
    """Convert a gain to an array, so that a program is compiled once for all gains.

    The array adopts the precision of the other operands.
    """
    given = isinstance(value, int | float | np.generic | np.ndarray)
    return jnp.asarray(np.asarray(value, float).tolist()) if given else value


def _check_each(domain: Domain, whose: str, **given: object) -> None:
    """Check numbers by their names; a traced one has no value that can be checked."""
    for name, value in given.items():
        domain.check(whose, name, value)


check_positive = partial(_check_each, POSITIVE)
"""Check that gains are positive, finite numbers."""
check_not_negative = partial(_check_each, NOT_NEGATIVE)
"""Check that gains are finite numbers ≥ 0."""
check_finite = partial(_check_each, FINITE_ENTRIES)
"""Check that arrays have finite entries."""


def check_free(whose: str, model: MechanicalSystem) -> None:
    """Check that a model has no closed loops, as their coordinates depend on each other, unlike coordinate errors."""
    if model.manifold.redundant:
        raise InputError(
            f"{whose}: its errors are differences of all coordinates, but a closed loop ties some together; take "
            "IntrinsicKalman, whose errors stay along the loop"
        )


def check_whole(whose: str, observer: AbstractObserver) -> None:
    """Check that an observer may be wrapped: its reports concern its own steps, which a wrapper would change."""
    if type(observer).reported is not AbstractObserver.reported:
        raise InputError(
            f"{whose}: what {type(observer).__name__} reports is about its own steps, and not about those that {whose} "
            "makes of them; put it around the others"
        )


def as_numbers(whose: str, what: str, value: Numbers, count: int | None, least: float = -np.inf) -> np.ndarray:
    """Check one number or `count` numbers, all at least `least`, and return `count` of them."""
    try:
        given = np.asarray(value, float)
        numbers = np.broadcast_to(given, (given.size if count is None else count,))
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if not (np.isfinite(numbers).all() and (numbers >= least).all()):
        kind = "numbers ≥ 0" if least == 0 else "finite numbers"
        others = {None: " or several", 1: "", 3: " or three"}.get(count, f" or {count}")
        raise InputError(f"{whose}: {what} must be one number{others}, {kind}; got {value}")
    return numbers


def no_input(model: MechanicalSystem | StateSpace, like: Vector) -> Float[Array, "m"]:
    """Zero input of a model.

    Args:
        model: Model with an attribute `inputs`.
        like: A vector (n,). Its length is the number of inputs if the model does not state one; the result has its
            precision.

    Returns:
        Zeros (m,).
    """
    return jnp.zeros(input_count(model, like.shape[0]), like.dtype)


def with_velocity(state: Any, v: Vector) -> Any:
    """State of an observer, or of an inner one, with another velocity, which it takes for known: no start is needed."""
    if "v" in state._fields:
        return state._replace(v=v)
    if getattr(state, "running", None) is not None:
        state = state._replace(running=jnp.full_like(state.running, jnp.inf))
    if "inner" not in state._fields:
        raise InputError(f"{type(state).__name__}: the state of this observer has no velocity to start with")
    return state._replace(inner=with_velocity(state.inner, v))


def time_since_measurement(state: Any) -> Scalar:
    """Time [s] from the last measurement to the end of the prediction that led to a state."""
    return state.age


def step_length(state: Any) -> Scalar:
    """Length [s] of the prediction that led to a state, for observers whose correction depends on it."""
    return state.dt


def still(stored: LastInput | Scalar) -> Any:
    """Time derivative of a field that is only stored between samples: zero, in the same form."""
    return jax.tree.map(jnp.zeros_like, stored)


def continuous(state: State) -> State:
    """State without the fields that are only stored between samples, for use in a differential equation.

    Args:
        state: State of an observer.

    Returns:
        The state with None in those of the fields `last_input`, `age` and `dt` that it has.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> state = observers.ModelCopy(models.oscillator(), alpha=2.0, beta=4.0).init(jnp.zeros(1))
        >>> observers.continuous(state).last_input is None
        True
    """
    return state._replace(**{name: None for name in ("last_input", "age", "dt") if name in state._fields})


def _has_last_input(state: Fields) -> bool:
    """Whether the state has a field for the last finite input."""
    return "last_input" in state._fields


def _stores_input(state: Any, u: Array) -> bool:
    return _has_last_input(state) and state.last_input is not None and state.last_input.shape == u.shape


def _replacement_input(state: Any, u: Array) -> Array:
    """The replacement for an input that is not finite: the last finite one, or zero if the state stores none."""
    return state.last_input.astype(u.dtype) if _stores_input(state, u) else jnp.zeros_like(u)


def _with_missing_input(state: Any, u: Array) -> Any:
    """The state, with flags for replaced inputs in its field `missing_input` if it has one."""
    flags = state.missing_input if "missing_input" in state._fields else None
    return state if flags is None or flags.shape != u.shape else state._replace(missing_input=~jnp.isfinite(u))


def _with_last_input(advanced: Any, state: Any, u: Array) -> Any:
    """The new state, which stores the input if the old one does: the form of a state must not change."""
    if _stores_input(state, u):
        return advanced._replace(last_input=u.astype(state.last_input.dtype))
    return advanced._replace(last_input=state.last_input) if _has_last_input(state) else advanced


def _input_fault(u: Array, too_large: Array, dt: Scalar) -> Code:
    """The worst fault of a sample, except for missing measurements, which the observer itself reports."""
    # The least normal number: processors that flush subnormal numbers to zero ignore smaller steps.
    tiny = jnp.finfo(dt.dtype).tiny
    faults = (
        (jnp.any(too_large), StepCode.COASTED),
        (~jnp.all(jnp.isfinite(u)), StepCode.INPUT_HELD),
        (jnp.abs(dt) < tiny, StepCode.REPEATED),
        (~(jnp.isfinite(dt) & (dt > -tiny)), StepCode.STEP_REFUSED),
    )
    code = jnp.asarray(int(StepCode.OK))
    # Ordered by severity: a later fault replaces an earlier one.
    for occurred, result in faults:
        code = jnp.where(occurred, int(result), code)
    return code


def outcome(q: Array, v: Array, y: Array, result: Code | int = StepCode.OK) -> Code:
    """Result code of a step, by the precedence `NOT_FINITE`, `COASTED`, `result`.

    A position so large that floating-point numbers cannot resolve one unit counts as not finite, since differences of
    such positions are meaningless.
    """
    # Beyond 1/ε neighbouring floating-point numbers are 1 or more apart.
    finite = jnp.all(jnp.abs(q) < 1 / jnp.finfo(q.dtype).eps) & jnp.all(jnp.isfinite(v))
    measured = jnp.where(jnp.any(jnp.isnan(y)), int(StepCode.COASTED), result)
    return jnp.where(finite, measured, int(StepCode.NOT_FINITE)).astype(jnp.int32)


def in_jax(record: Record) -> tuple[Array, Array, Array]:
    """Convert stamps, inputs and measurements of a checked record to arrays of JAX, with stamps that stay distinct.

    In single precision, stamps far from zero would lose the steps between them, and no result code would show it.
    """
    t, u, y = map(jnp.asarray, record[:3])
    stamps = np.asarray(record.t)
    if np.issubdtype(stamps.dtype, np.floating):
        check_rounding(stamps, t.dtype)
    return t, u, y


class Rows(NamedTuple):
    """The steps of a record, one for each row.

    Attributes:
        u: Inputs (T, m) that acted since the previous stamp.
        y: Measurements (T, *n).
        dt: Times (T,) since the previous stamp [s], 0 for the first row.
    """

    u: Array
    y: Array
    dt: Array

    @classmethod
    def of(cls, t: Array, u: Array, y: Array, input_at_end: bool = False) -> "Rows":
        """Steps of the stamps t (T,), inputs u (T, m) and measurements y (T, *n) of a record."""
        # The input of a row is held from its stamp on, so a step uses the input of the previous row.
        return cls(u if input_at_end else jnp.concatenate([u[:1], u[:-1]]), y, jnp.diff(t, prepend=t[:1]))


def scan(observer: AbstractObserver[State, Report], state: State, rows: Rows) -> tuple[State, tuple[Any, Report]]:
    """Run an observer over rows, starting from a state."""

    def step(state, row):
        state, info = observer.step(state, *row)
        # `init` has used the first row, so its dt = 0 does not mean a repeated stamp.
        first = (row.dt == 0) & (info.result == int(StepCode.REPEATED))
        info = info._replace(result=jnp.where(first, int(StepCode.OK), info.result))
        return state, (observer.estimate(state), info)

    return jax.lax.scan(step, state, rows)


def kept(info: Report, keep: Collection[str] | None) -> Report:
    """The info with None in the fields that `keep` does not name; unchanged if `keep` is None."""
    return info if keep is None else info._replace(**dict.fromkeys(set(info._fields) - set(keep)))


@eqx.filter_jit
def _scan(observer: AbstractObserver, t: Array, u: Array, y: Array, keep: frozenset[str] | None):
    estimate, info = scan(observer, observer.init(y[0], t[0]), Rows.of(t, u, y, observer.input_at_end))[1]
    return estimate, kept(info, keep)


def checked(observer: AbstractObserver, record: Record) -> Record:
    """Check that a record fits an observer.

    Args:
        observer: The observer that is to run over it.
        record: A log. Traced measurements have no values to check.

    Returns:
        The record itself.

    Raises:
        ValueError: From `Record.check`; or the first measurement is larger than `AbstractObserver.largest`, or the
            measurement of a row, the first of which is named, is not a configuration of the observer's model.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> observer = observers.ModelCopy(models.oscillator(), alpha=2.0, beta=4.0)
        >>> record = Record(np.array([0.0, 0.1]), np.zeros((2, 1)), np.zeros((2, 1)))
        >>> observers.checked(observer, record) is record
        True
    """
    shape = np.shape(record.y)[1:]
    start = observer.configuration(np.arange(math.prod(shape)).reshape(shape)).ravel() if shape else None
    manifold = observer.manifold
    redundant = manifold is not None and manifold.redundant
    if redundant and start is not None and not isinstance(record.y, Tracer) and len(record.t):
        # Other entries may determine the missing ones; if they do not, `AbstractManifold.checked` reports it.
        start = start[~np.isnan(np.asarray(record.y, float)[0].ravel()[start])]
    y = record.check(start, missing_inputs=True).y
    if isinstance(y, Tracer):
        return record
    if manifold is not None and redundant:
        manifold.checked(jnp.asarray(observer.configuration(np.asarray(y)[0])))
    first = np.asarray(y)[0]  # a value even in a compiled function, in which JAX's own indexing would be traced
    if (np.abs(first) > observer.largest(first)).any():
        raise InputError("row 1: the measurement is too large for a start; cut the log to begin later")
    admitted = np.asarray(jax.vmap(observer.admitted)(jnp.asarray(y)))
    bad = (np.isnan(admitted) & ~np.isnan(y)).reshape(len(y), -1).any(1)
    if bad.any():
        raise InputError(
            f"row {bad.argmax() + 1}: the measurement is no configuration of the model; pass rotations as matrices, "
            "and NaN in all entries of one that is missing"
        )
    return record


def run(observer: AbstractObserver, record: Record, keep: Collection[str] | None = None) -> Run:
    """Run an observer over a record. Row k of the run depends on the measurements up to row k only.

    Use it for a complete log, in a script or under `jax.jit`. `engine.run_log` gives the same numbers, up to rounding,
    by compiled C and is faster on long logs. `engine.Stream` takes samples one by one, and the verb
    `covariant.estimate` starts from files. The first row starts the estimate, so its measurement should be complete. A
    step never raises an error: read `info.result`.

    Args:
        observer: The observer.
        record: A log; the input of a row acts from its stamp to the next.
        keep: Names of the fields of the info to store; the others are None in the result, and take no memory on a long
            log. None (default) stores all. Names that the observer's info does not have are ignored.

    Returns:
        A `Run` with the stamps, the estimates and the info of every row.

    Raises:
        ValueError: From `Record.check`, or a measurement is not a configuration.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> record = Record(t, np.zeros((401, 1)), np.cos(t)[:, None])  # a unit mass on a unit spring
        >>> run = observers.run(observers.Intrinsic(models.oscillator(), alpha=4.0, beta=8.0), record)
        >>> run
        <Run: 401 rows over 4 s, 401 ok>
        >>> bool(np.allclose(run.estimate[-1], [np.cos(4.0), -np.sin(4.0)], atol=1e-3))
        True
    """
    t, u, y = in_jax(checked(observer, record))
    fields = None if keep is None else frozenset(keep)
    estimate, info = _scan(observer, t, u, y, fields)
    return Run(t, estimate, info)
