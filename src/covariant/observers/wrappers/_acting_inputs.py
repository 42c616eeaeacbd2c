"""Wraps an observer for inputs that act later than they are sent, by storing past inputs in its state.

A step from t to t + dt needs the mean of the input that acts in it. With a delay d, that is the mean of the input that
was sent from t − d to t + dt − d. It follows from the last rows of the input, each held from its stamp to the next. The
results equal those of `signals.lag_inputs` and `signals.acting_inputs` for a whole log.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

from covariant._typing import Number, Scalar
from covariant.observers.base import AbstractObserver, AbstractWrapper, Fields, as_numbers
from covariant.signals import LEAST_MISSING, MOST_MISSING, SAME_TIME
from scalargraph.errors import InputError

SPARE_ROWS = 2
"""Rows in addition to those for regular stamps, since irregular stamps may put a few more into the same time."""


class ActingInputsState(NamedTuple):
    """State of an `ActingInputs` observer: the state of its inner observer, and the last inputs.

    Attributes:
        inner: State of the inner observer.
        age: Ages (L,) [s] of the stored inputs, the oldest first; infinity marks an empty entry.
        u: Stored inputs (L, m), after the lag.
        missing: Fraction of each stored input (L, m) that comes from missing inputs, from 0 to 1.
        sent: Last finite input (m,) as it was sent; 0 before the first one.
        acting: Mean input (m,) that acted in the last step; NaN where it depends on missing inputs.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> copy = observers.ModelCopy(models.oscillator(), alpha=2.0, beta=4.0)
        >>> state = observers.ActingInputs(copy, rate=100.0, delay=0.03).init(jnp.array([0.5]))
        >>> state.u.shape, state.age.tolist()[-1]
        ((6, 1), inf)
    """

    inner: Fields
    age: Float[Array, "L"]
    u: Float[Array, "L m"]
    missing: Float[Array, "L m"]
    sent: Float[Array, "m"]
    acting: Float[Array, "m"]


class ActingInputs(AbstractWrapper):
    """Any observer, for inputs that act later than they are sent, as the commands of a servo do.

    Pass the inputs as they are sent; each step computes the mean of the input that acts in it. For times before the
    first input, the first input acts. A mean that depends on a missing input counts as missing. The results equal those
    of `signals.lag_inputs` and `signals.acting_inputs`, which `covariant.estimate` applies to a log.

    Use it for a command or a torque with a known delay or lag, in a stream or in exported code. It has to be the
    outermost wrapper. If samples come faster than `rate`, the stored inputs may not reach back far enough; then the
    oldest stored input acts in place of earlier ones.

    Args:
        observer: Observer to which the acting inputs are passed.
        rate: Highest sampling rate [Hz], from which the number of stored inputs follows.
        delay: Time from the stamp of an input until it acts [s]: a number, or one for each input (m,).
        lag: Time constant of a first-order lag [s] before the delay: a number, or one for each input (m,).
        lead: Time [s] by which the rate of an input is multiplied, before it is added to the input: a number, or one
            for each input (m,).
        between: Course of an input between samples. With "held", pass each step the input at its begin. With "linear",
            pass each step the input at its end; a step of length 0 after `init` passes the first input.
        inputs: Number of inputs m; by default the largest length of `delay`, `lag` and `lead`.

    Raises:
        ValueError: A delay or lag is negative or not finite, a lead is not finite, `rate` is not positive and finite,
            `between` is unknown, or a sequence does not have one number for each input.

    Example:
        The input is 0 in the first step and 1 from 0.1 s on, and acts 0.15 s later.

        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> copy = observers.ModelCopy(models.oscillator(), alpha=2.0, beta=4.0)
        >>> observer = observers.ActingInputs(copy, rate=10.0, delay=0.15)
        >>> state = observer.init(jnp.zeros(1))
        >>> for u in (0.0, 1.0, 1.0, 1.0):
        ...     state, info = observer.step(state, jnp.array([u]), jnp.zeros(1), 0.1)
        ...     print(round(state.acting.item(), 6))
        0.0
        0.0
        0.5
        1.0
    """

    observer: AbstractObserver
    delay: tuple[float, ...] = eqx.field(static=True)
    lead: tuple[float, ...] = eqx.field(static=True)
    lag: tuple[float, ...] = eqx.field(static=True)
    linear: bool = eqx.field(static=True)
    length: int = eqx.field(static=True)

    def __init__(
        self,
        observer: AbstractObserver,
        rate: float,
        delay: Number | Sequence[float] = 0.0,
        lag: Number | Sequence[float] = 0.0,
        lead: Number | Sequence[float] = 0.0,
        between: str = "held",
        inputs: int | None = None,
    ):
        if between not in ("held", "linear"):
            raise InputError(f"ActingInputs: between must be 'held' or 'linear'; got {between!r}")
        if not 0 < rate < math.inf:
            raise InputError(f"ActingInputs: rate must be a positive number [Hz]; got {rate}")
        count = inputs if inputs is not None else max(map(np.size, (delay, lag, lead)))
        delays, lags = (
            as_numbers("ActingInputs", name, value, count, 0.0) for name, value in (("delay", delay), ("lag", lag))
        )
        leads = as_numbers("ActingInputs", "lead", lead, count)
        self.observer, self.delay, self.lag = observer, tuple(delays.tolist()), tuple(lags.tolist())
        self.lead = tuple(leads.tolist())
        longest = float(delays.max(initial=0.0))
        self.linear = between == "linear"
        # 1e-9 keeps rounding from adding one.
        rows = math.ceil(longest * rate - 1e-9) + 1
        # The rate of an input needs the input before it as well.
        self.length = rows + (self.linear or bool(leads.any())) + (SPARE_ROWS if longest else 0)

    @property
    def input_at_end(self) -> bool:
        return self.linear

    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> ActingInputsState:
        inner = self.observer.init(y, t)
        real = jnp.real(jnp.asarray(y)).dtype
        none = jnp.zeros(len(self.delay), real)
        rows = jnp.zeros((self.length, len(self.delay)), real)
        return ActingInputsState(inner, jnp.full(self.length, jnp.inf, real), rows, rows, none, none)

    def estimate(self, state: ActingInputsState) -> Any:
        return self.observer.estimate(state.inner)

    def step(
        self, state: ActingInputsState, u: Float[Array, "m"], y: Inexact[Array, "*n"], dt: Number
    ) -> tuple[ActingInputsState, Any]:
        """Store the input, then step the inner observer under the mean input that acts in the step.

        Args:
            state: State after the previous sample.
            u: Input (m,) that was sent at the previous sample and held since then; with linear inputs, the input of
                this sample. NaN marks a missing input.
            y: Measurement at the end of the step.
            dt: Time from the previous sample to this one [s].

        Returns:
            The state, and the info of the inner observer, whose result codes refer to the acting input.
        """
        dt = jnp.asarray(dt, jnp.result_type(dt, state.age.dtype))
        advances = jnp.isfinite(dt) & (dt >= jnp.finfo(dt.dtype).tiny)
        length = jnp.where(advances, dt, 0.0).astype(state.age.dtype)
        # A refused step stores nothing. A step of length 0 stores its input only if inputs are linear, since the input
        # is then that of its end.
        stores = advances | (jnp.abs(dt) < jnp.finfo(dt.dtype).tiny) if self.linear else advances
        moved = self._stored(state, u, length)
        inner, info = self.observer.step(state.inner, moved.acting.astype(u.dtype), y, dt)
        memory, before = moved._replace(inner=None), state._replace(inner=None)
        memory = jax.tree.map(lambda new, old: jnp.where(stores, new, old), memory, before)
        return memory._replace(inner=inner), info

    def predict(self, state: ActingInputsState, u: Float[Array, "m"], dt: Scalar) -> ActingInputsState:
        moved = self._stored(state, u, dt)
        return moved._replace(inner=self.observer.predict(state.inner, self._known(moved), dt))

    def correct(
        self, state: ActingInputsState, u: Float[Array, "m"], y: Inexact[Array, "*n"]
    ) -> tuple[ActingInputsState, Any]:
        inner, info = self.observer.correct(state.inner, self._known(state), y)
        return state._replace(inner=inner), info

    def innovation(self, state: ActingInputsState, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> Any:
        return self.observer.innovation(state.inner, self._known(state), y)

    def _known(self, state: ActingInputsState) -> Float[Array, "m"]:
        """The acting input, with the last sent input in place of a missing one."""
        return jnp.where(jnp.isfinite(state.acting), state.acting, state.sent)

    def _stored(self, state: ActingInputsState, u: Float[Array, "m"], dt: Scalar) -> ActingInputsState:
        """The state dt later with the input of that step stored, and the mean input that acts in the step."""
        absent = ~jnp.isfinite(u)
        sent = jnp.where(absent, state.sent, u).astype(state.sent.dtype)
        value, missing = sent, absent.astype(sent.dtype)
        age = state.age + dt if self.linear else state.age
        gap = age[-1]  # infinite before the first input
        if any(self.lag):
            decay = jnp.stack([jnp.exp(-gap / lag) if lag else jnp.zeros_like(gap) for lag in self.lag])
            value = decay * state.u[-1] + (1 - decay) * value
            missing = decay * state.missing[-1] + (1 - decay) * missing

        def appended(rows: Array, row: Array) -> Array:
            longer = jnp.concatenate([rows[1:], row[None]])
            # An input with the same stamp as the last one replaces it.
            return jnp.where(gap == 0, rows.at[-1].set(row), longer) if self.linear else longer

        stored = state._replace(
            age=appended(age, jnp.zeros_like(gap)) + (0.0 if self.linear else dt),
            u=appended(state.u, value),
            missing=appended(state.missing, missing),
            sent=sent,
        )
        return stored._replace(acting=self._mean(stored, dt))

    def _mean(self, state: ActingInputsState, dt: Scalar) -> Float[Array, "m"]:
        """Mean (m,) of the inputs that act in the last dt [s]; NaN where it depends on a missing input."""
        gone = (state.missing > MOST_MISSING).astype(state.u.dtype)
        means = [jnp.zeros((), state.u.dtype)] * len(self.delay)
        # Inputs with equal delay and lead have the same weights.
        times = tuple(zip(self.delay, self.lead, strict=True))
        for delay, lead in dict.fromkeys(times):
            weights = self._weights(state.age, delay, lead, dt)
            for i in (i for i, each in enumerate(times) if each == (delay, lead)):
                # A lead has weights of either sign; a change from a missing input to a known one is not known either.
                absent = jnp.abs(jnp.sum(weights * gone[:, i])) > LEAST_MISSING
                means[i] = jnp.where(absent, jnp.nan, jnp.sum(weights * state.u[:, i]))
        return jnp.stack(means) if means else jnp.zeros(0, state.u.dtype)

    def _weights(self, age: Float[Array, "L"], delay: float, lead: float, dt: Scalar) -> Float[Array, "L"]:
        """Weights (L,) of stored inputs in the mean of the input that acts from age delay + dt to age delay."""
        there = jnp.isfinite(age)
        first = there & ~jnp.concatenate([jnp.zeros(1, bool), there[:-1]])
        # The oldest stored input acts for all times before its stamp as well, and the last one until another is sent.
        since, until = jnp.where(first, jnp.inf, age), jnp.append(age[1:], -jnp.inf)
        acted = jnp.maximum(jnp.minimum(delay + dt, since) - jnp.maximum(delay, until), 0.0)
        acted = jnp.where(there, acted, 0.0)
        # A linear input goes from one stored value to the next between the ages `start` and `end`.
        both = there[:-1]
        start, end = jnp.where(both, age[:-1], 0.0), jnp.where(both, age[1:], -1.0)

        def passed_on(part: Array) -> Array:
            """Weights that give `part` of each pair to its later input, and take it from the earlier one."""
            part = jnp.where(both, part, 0.0)
            return jnp.concatenate([jnp.zeros(1, part.dtype), part]) - jnp.append(part, 0.0)

        def at(edge: Scalar) -> Array:
            """Weights of the stored inputs in the input at an age; at a jump, the value before it."""
            if not self.linear:
                edge = edge + SAME_TIME
                return (there & (since > edge) & (until <= edge)).astype(age.dtype)
            return first.astype(age.dtype) + passed_on(jnp.clip((start - edge) / (start - end), 0.0, 1.0))

        if self.linear:
            begin, stop = jnp.minimum(delay + dt, start), jnp.maximum(delay, end)
            # The mean over a time between two stamps has the weight of its middle, which increases to the later stamp.
            acted += passed_on(jnp.maximum(begin - stop, 0.0) * (start - (begin + stop) / 2) / (start - end))
        if lead:
            acted += lead * (at(jnp.asarray(delay, age.dtype)) - at(delay + dt))
        return acted / jnp.where(dt > 0, dt, 1.0)
