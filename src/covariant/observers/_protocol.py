"""The protocol that all observers share, and the loop that drives them.

An observer is a frozen recipe. What it remembers is a state, which the caller holds; what a person may want to know
about a step is its info. Writing the loop by hand takes four lines:

    state = observer.init(y[0], t[0])
    for k in range(1, len(t)):
        state, info = observer.step(state, u[k - 1], y[k], t[k] - t[k - 1])
        x = observer.estimate(state)

A step has two halves, which an observer defines and a caller may take one at a time: `predict` moves the state to the
time of a measurement, `correct` corrects it there. Whatever is built of observers, such as a gate or a buffer for late
sensors, is built of these two.
"""

import abc
from collections.abc import Callable, Collection
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Inexact

from covariant._functional import Functional
from covariant._typing import Code, Number, Scalar, Vector
from covariant.models import MechanicalSystem, Motion, input_count
from covariant.signals import Record, Result, Run

MOST_TURNS = 1e9
"""An angle of more turns than this counts as missing: the digits that are left say little of its place on a circle."""
LEAST_OF_A_TURN = 1e-3
"""What an angle has to resolve, in turns; in single precision that leaves 8 000 turns."""

Held = Float[Array, "m"] | None
"""The last finite input, in the field `held` of a state; None where the state keeps none."""


class MechanicalState(NamedTuple):
    """Estimated configuration and velocity, and the time [s] they belong to (for forces that depend on time)."""

    q: Vector
    v: Vector
    t: Scalar


class HeldState(NamedTuple):
    """As `MechanicalState`, with what is remembered between samples.

    - `held` (m,): the last finite input, which replaces an input that is not finite; where it is None, zero does.
    - `age`: time since the last measurement [s]; where it is None, every step counts as following one.
    """

    q: Vector
    v: Vector
    t: Scalar
    held: Held = None
    age: Scalar | None = None


class Info(NamedTuple):
    """Diagnostics of a step.

    - `innovation` (n,): the difference from q̂ to y before the correction, y − q̂ in coordinates, with angles wrapped,
      and 0 for a missing measurement.
    - `distance`: its length in the metric.
    - `result`: a `covariant.signals.Result` code.
    """

    innovation: Vector
    distance: Scalar
    result: Code


class AbstractObserver(Functional):
    """Estimates the state from measured positions, sample by sample.

    `step` predicts the state at the time stamp of y and then corrects it by y. A subclass writes its algorithm in
    `predict` and `correct`, which get valid numbers only: `step` is the same for all observers and sees to that. A
    state whose field `held` has the shape of the input remembers the last finite input in it.
    """

    @abc.abstractmethod
    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> Any:
        """State at rest at the measured configuration y, at time t [s].

        Raises `ValueError` where y is no configuration. In a compiled function, the state is not finite there.
        """

    @final
    def step(self, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"], dt: Number) -> tuple[Any, Any]:
        """Advance by dt [s] under the input u (m,), held constant over the step, then correct by the measurement y.

        NaN in y marks a missing measurement, over which the model predicts alone. Invalid numbers never spoil the
        state. An entry of y that is infinite or larger than `largest` counts as missing, as NaN does, and so does a
        matrix that is no rotation. An entry of u that is not finite is replaced by the last finite one, or by 0 before
        there is any. Where dt is zero, negative or not finite, the state is left as it was; a subnormal dt, which
        processors may take for zero, is zero. `info.result` reports this: `COASTED`, `INPUT_HELD`,
        `REPEATED` (dt = 0) or `STEP_REFUSED`, the worst one where several apply. Returns the new state and the info.
        """
        dt = jnp.asarray(dt, jnp.result_type(dt, jnp.finfo(y.dtype).dtype))  # a number of Python's own has no type
        moves = jnp.isfinite(dt) & (dt >= jnp.finfo(dt.dtype).tiny)
        sound = jnp.where(jnp.isfinite(u), u, _held(state, u))
        far = jnp.abs(y) > self.largest(y)
        measured = self.admitted(jnp.where(far, jnp.nan, y))
        # Where the state is left as it was no input acts: what it would do has no influence on the result either.
        moved, info = self.advance(state, jnp.where(moves, sound, 0.0), measured, jnp.where(moves, dt, 0.0))
        kept = jax.tree.map(lambda new, old: jnp.where(moves, new, old), _holding(moved, state, sound), state)
        result = jnp.maximum(info.result, _fault(u, far, dt).astype(info.result.dtype))
        return kept, info._replace(result=result)

    def advance(self, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"], dt: Scalar) -> tuple[Any, Any]:
        """Prediction and correction: `step` for valid numbers, in the form that the state has.

        Args:
            state: The state after the sample before.
            u: Input (m,), finite, held constant over the step.
            y: Measurement, finite or NaN where missing.
            dt: Length of the step [s], finite and ≥ 0.

        Returns:
            The new state and the info.
        """
        corrected, info = self.correct(self.predict(state, u, dt), u, y)
        # A field that is None in the state, such as `age` in one that was made by hand, is None in the next one too.
        return corrected._replace(**{name: None for name in state._fields if getattr(state, name) is None}), info

    @abc.abstractmethod
    def predict(self, state: Any, u: Float[Array, "m"], dt: Scalar) -> Any:
        """The state dt [s] later, without a measurement: dt is finite and ≥ 0, and the input u finite and constant."""

    @abc.abstractmethod
    def correct(self, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> tuple[Any, Any]:
        """Correct a predicted state by a measurement at its own time.

        Args:
            state: What `predict` returned.
            u: Input (m,), finite, that acted over the prediction.
            y: Measurement, finite or NaN where missing.

        Returns:
            The new state and the info.
        """

    def innovation(self, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> Vector:
        """The innovation (n,) of a measurement at a predicted state: that of the info of `correct`, by less work."""
        return self.correct(state, u, y)[1].innovation

    def largest(self, y: Inexact[Array, "*n"] | np.ndarray) -> np.ndarray:
        """The largest magnitudes of the entries of a measurement like y; what is larger counts as missing.

        Beyond 1/ε floating-point numbers do not resolve one unit, and angles on a circle are to be found on it.
        """
        eps = float(jnp.finfo(y.dtype).eps)
        bounds = np.full(y.shape, 1 / eps, jnp.finfo(y.dtype).dtype)
        circles = getattr(self, "circles", None) or getattr(getattr(self, "model", None), "circles", ())
        bounds[list(circles)] = 2 * np.pi * min(MOST_TURNS, LEAST_OF_A_TURN / eps)
        return bounds

    def admitted(self, y: Inexact[Array, "*n"]) -> Inexact[Array, "*n"]:
        """The measurement y, with NaN in the place of what is no configuration of the observer's model."""
        manifold = getattr(getattr(self, "model", None), "manifold", None)
        return y if manifold is None else manifold.admitted(y)

    @abc.abstractmethod
    def estimate(self, state: Any) -> Any:
        """The estimate x = (q, v) (2n,) of a state; a `Motion` for a system that is not in coordinates."""


class AbstractFlowObserver(AbstractObserver):
    """An observer that is given by a differential equation."""

    @abc.abstractmethod
    def flow(self, t: Scalar, state: Any, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> Any:
        """Time derivative of the state, for measurements in continuous time."""


class AbstractMechanicalObserver(AbstractFlowObserver):
    """An observer of a `MechanicalSystem` whose state holds its estimate as q and v.

    In what its `flow` returns, the field q holds the velocity w (n,) of the estimate in the frame, `q̂' = E(q̂)w`.
    """

    model: eqx.AbstractVar[MechanicalSystem]

    def estimate(self, state: Any) -> Any:
        return self.model.state(Motion(state.q, state.v))

    def innovation(self, state: Any, u: Float[Array, "m"], y: Array) -> Vector:
        return self.model.manifold.towards(state.q, y)


def at_rest(model: MechanicalSystem, y: Array, t: Number) -> HeldState:
    """The state at rest at the first measurement; as `AbstractManifold.checked` says where y is no configuration."""
    q = model.manifold.checked(y)
    rest = model.manifold.zero(q)
    t = jnp.asarray(t, rest.dtype)
    return HeldState(q, rest, t, no_input(model, rest), jnp.zeros_like(t))


def since(state: Any, dt: Scalar) -> Scalar:
    """Time since the last measurement [s] at the end of a step."""
    return dt if state.age is None else state.age + dt


def aged(model: MechanicalSystem, state: Any, y: Array) -> Scalar:
    """The `age` of a predicted state after the measurement y: as it was where all of y is missing, else zero."""
    return state.age * jnp.all(model.manifold.missing(y)).astype(state.age.dtype)


def uniqueness(model: MechanicalSystem, q: Array, y: Array) -> Code:
    """`OK`, or `CUT_LOCUS` where two shortest paths lead from q to the measurement."""
    unique = model.manifold.unique(q, model.manifold.measured(q, y))
    return jnp.where(unique, int(Result.OK), int(Result.CUT_LOCUS)).astype(jnp.int32)


def as_gain(value: Any) -> Any:
    """A gain as an array, so that a program is compiled once for all gains. It adopts the precision of other operands.

    Anything that is not a number is returned as it is, so that the checks can name it.
    """
    return jnp.asarray(float(value)) if isinstance(value, int | float | np.generic) else value


def check_positive(whose: str, **gains: Any) -> None:
    """Raise `ValueError` for a gain that is not a positive, finite number; a traced gain has no value to check."""
    for name, gain in gains.items():
        if not _known(gain, lambda a: np.isfinite(a) & (a > 0)):
            raise ValueError(f"{whose}: {name} must be a positive, finite number; got {_written(gain)}")


def check_finite(whose: str, **given: Any) -> None:
    """Raise `ValueError` where an array has an entry that is not finite; a traced array has no values to check."""
    for name, array in given.items():
        if not _known(array, np.isfinite):
            raise ValueError(f"{whose}: {name} must have finite entries; got {_written(array)}")


def _known(value: Any, good: Callable[[np.ndarray], Any]) -> bool:
    if isinstance(value, Tracer):
        return True
    try:
        return bool(np.all(good(np.asarray(value, float))))
    except (TypeError, ValueError):  # it does not hold numbers
        return False


def _written(value: Any) -> str:
    return " ".join(str(np.asarray(value)).split())


def no_input(model: Any, like: Vector) -> Float[Array, "m"]:
    """Zero input of the size the model takes, or of the size of its coordinates `like` where it states none."""
    return jnp.zeros(input_count(model, like.shape[0]), like.dtype)


def still(kept: Held | Scalar) -> Any:
    """Time derivative of what is remembered between samples: zero, in the same form."""
    return jax.tree.map(jnp.zeros_like, kept)


def continuous(state: Any) -> Any:
    """The state without what is remembered between samples, which a differential equation does not need."""
    return state._replace(**{name: None for name in ("held", "age", "dt") if name in state._fields})


def _holds(state: Any) -> bool:
    return "held" in state._fields


def _keeps_input(state: Any, u: Array) -> bool:
    return _holds(state) and state.held is not None and state.held.shape == u.shape


def _held(state: Any, u: Array) -> Array:
    """The input that replaces one that is not finite."""
    return state.held.astype(u.dtype) if _keeps_input(state, u) else jnp.zeros_like(u)


def _holding(moved: Any, state: Any, u: Array) -> Any:
    """The new state, with the input stored in it where the old state keeps one: the form of a state must not change."""
    if _keeps_input(state, u):
        return moved._replace(held=u.astype(state.held.dtype))
    return moved._replace(held=state.held) if _holds(state) else moved


def _fault(u: Array, far: Array, dt: Scalar) -> Code:
    """The worst fault of a sample, apart from what the observer itself reports about a missing measurement."""
    tiny = jnp.finfo(dt.dtype).tiny
    faults = (
        (jnp.any(far), Result.COASTED),
        (~jnp.all(jnp.isfinite(u)), Result.INPUT_HELD),
        (jnp.abs(dt) < tiny, Result.REPEATED),
        (~(jnp.isfinite(dt) & (dt > -tiny)), Result.STEP_REFUSED),
    )
    code = jnp.asarray(int(Result.OK))
    for present, result in faults:
        code = jnp.where(present, int(result), code)
    return code


def outcome(q: Array, v: Array, y: Array, result: Code | int = Result.OK) -> Code:
    """Result code of a step: `NOT_FINITE` takes precedence over `COASTED`, and this over the step's own `result`.

    A position so large that floating-point numbers cannot resolve one unit counts as not finite: differences of such
    positions mean nothing.
    """
    finite = jnp.all(jnp.abs(q) < 1 / jnp.finfo(q.dtype).eps) & jnp.all(jnp.isfinite(v))
    measured = jnp.where(jnp.any(jnp.isnan(y)), int(Result.COASTED), result)
    return jnp.where(finite, measured, int(Result.NOT_FINITE)).astype(jnp.int32)


@eqx.filter_jit
def _scan(observer: AbstractObserver, t: Array, u: Array, y: Array, keep: frozenset[str] | None):
    before = jnp.concatenate([u[:1], u[:-1]])  # the input that acted since the previous stamp
    dt = jnp.diff(t, prepend=t[:1])

    def step(state, sample):
        state, info = observer.step(state, *sample)
        # The first row starts the state: it is not a step, and repeats no earlier stamp.
        first = (sample[2] == 0) & (info.result == int(Result.REPEATED))
        info = info._replace(result=jnp.where(first, int(Result.OK), info.result))
        dropped = () if keep is None else set(info._fields) - keep
        return state, (observer.estimate(state), info._replace(**dict.fromkeys(dropped)))

    return jax.lax.scan(step, observer.init(y[0], t[0]), (before, y, dt))[1]


def checked(observer: AbstractObserver, record: Record) -> Record:
    """The record, fit for the observer.

    Raises `ValueError` from `Record.check`, and for the first row with a measurement that is no configuration of the
    observer's model; traced measurements have no values to check.
    """
    y = record.check().y
    if isinstance(y, Tracer):
        return record
    first = np.asarray(y)[0]  # a value even inside a compiled function, where indexing in JAX is traced
    if (np.abs(first) > observer.largest(first)).any():
        raise ValueError("row 1: the measurement is too large for a start; cut the log to begin later")
    admitted = np.asarray(jax.vmap(observer.admitted)(jnp.asarray(y)))
    none = (np.isnan(admitted) & ~np.isnan(y)).reshape(len(y), -1).any(1)
    if none.any():
        raise ValueError(
            f"row {none.argmax() + 1}: the measurement is no configuration of the model; pass rotations as matrices, "
            "and NaN in all entries of one that is missing"
        )
    return record


def run(observer: AbstractObserver, record: Record, keep: Collection[str] | None = None) -> Run:
    """Run an observer over a record. Row k of the run depends on the measurements up to row k only.

    - `keep`: names of the fields of the info that are kept; those left out are None, and take no memory on a long log.
      By default all are kept. Names that an observer's info does not have are ignored.

    Returns a `Run` with the stamps, the estimates and the info of every row. Raises `ValueError` from `Record.check`,
    and for a measurement that is no configuration.
    """
    t, u, y, _ = checked(observer, record)
    kept = None if keep is None else frozenset(keep)
    estimate, info = _scan(observer, jnp.asarray(t), jnp.asarray(u), jnp.asarray(y), kept)
    return Run(jnp.asarray(t), estimate, info)
