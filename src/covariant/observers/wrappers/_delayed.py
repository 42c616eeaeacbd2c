"""Wraps observers for delayed sensors: readings count at the times at which they were true, the estimate is for now.

Coordinate i of the sample with the stamp t was true at t − d_i. The state is stored at t − max d, before which no
reading can arrive any more; later readings wait in a buffer. A sample is inserted into the buffer at its true times,
the inner observer runs through the buffer again in order, and the model predicts from the last reading to the stamp,
input by input. If the coordinates of a configuration have different delays, no single sample determines the
configuration at t − max d. Until every first reading is that old, each step restarts from the latest readings, with the
uncertainty of `init`; then the readings on both sides of that time are interpolated to the first state.

A step therefore costs one step of the inner observer for each reading that is newer than the slowest sensor's, and one
prediction for each row of the shortest delay. With one delay for all coordinates nothing waits in the buffer: a step
costs one step, and as many predictions as there are rows in the delay.

Source: Bar-Shalom 2002, Update with out-of-sequence measurements in tracking: exact solution, IEEE Transactions on
Aerospace and Electronic Systems 38(3), which shortens this for linear systems; Larsen, Andersen, Ravn & Poulsen 1998,
Incorporation of time delayed measurements in a discrete-time Kalman filter, CDC, for the alternatives.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact

from covariant._typing import Number, Scalar, Vector
from covariant.observers.base import AbstractObserver, AbstractWrapper, Fields, LastInput, check_whole
from covariant.observers.sensors import Sensors
from covariant.signals import SAME_TIME, StepCode
from scalargraph.errors import InputError

OF_ESTIMATE = ("velocity_std", "state_std", "slow", "slow_std")
"""Fields of an info that describe the estimate."""


class DelayedState(NamedTuple):
    """State of a `Delayed` observer: two states of its inner observer, and the readings and inputs between them.

    Ages [s] are counted back from now; infinity marks an empty entry of a buffer.

    Attributes:
        now: State of the inner observer now.
        t: Time now [s].
        known: State of the inner observer `age_of_known` ago, which no later reading can change.
        age_of_known: Age of `known` [s].
        age: Ages (L,) [s] of the readings since, the oldest first.
        y: These readings (L, *n); NaN where a coordinate was not read then.
        stamp: Ages (M,) [s] of the last stamps, the oldest first.
        u: Inputs (M, m) that acted up to each of these stamps.
        start_age: Ages (K,) [s] of the readings in `start_y`; infinite once a first state exists that combines several
            samples. Empty if a single sample determines the first configuration.
        start_y: Last reading (K,) of each entry of a measurement that was true before the first state.
        last_input: The last finite input (m,), or None for an inner observer that stores none.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import observers
        >>> observer = observers.Delayed(observers.FilteredDerivative(50.0), delay=0.05, rate=100.0)
        >>> state = observer.init(jnp.array([0.5]), t=1.0)
        >>> round(state.age_of_known.item(), 6), state.u.shape
        (0.05, (8, 0))
    """

    now: Fields
    t: Scalar
    known: Fields
    age_of_known: Scalar
    age: Float[Array, "L"]
    y: Inexact[Array, "L *n"]
    stamp: Float[Array, "M"]
    u: Float[Array, "M m"]
    start_age: Float[Array, "K"]
    start_y: Inexact[Array, "K"]
    last_input: LastInput = None


class Delayed(AbstractWrapper):
    """Any observer, for sensors whose readings arrive late.

    Between two readings, the mean of the inputs over that time acts. If samples come faster than `rate`, the buffers
    are too short: readings that are older are left out, and `result` says `TOO_LATE`. The info is that of the newest
    reading of a sample, with the innovations of all its readings. Its standard deviations, forces and other slow states
    are those of the present estimate. Without delays and lateness it equals the inner observer, to the last bit.

    Use it if a camera or a slow bus delivers measurements late. A known delay that is ignored makes the estimate late
    by as much, and a control loop unstable. It stores the past for the length of the delays, and repeats the steps
    since then.

    Args:
        observer: Observer to which the readings are passed, in the order of the times at which they were true.
        delay: Delay [s]: coordinate i of a sample with the stamp t was true at t − delay[i]. One number for all
            coordinates, as it must be on a group, or (n,).
        rate: Largest number of samples per second [Hz], which determines the length of the buffers.
        lateness: Time [s] by which a sample may arrive even later than its delay, 0 by default; see `late`.

    Raises:
        ValueError: A delay or the lateness is not finite and ≥ 0, the rate is not positive and finite, or the reports
            of the observer concern its own steps, such as a proved bound.

    Example:
        A ramp of slope 2/s, read 0.1 s late: the estimate is for now all the same.

        >>> import numpy as np
        >>> from covariant import Record, observers
        >>> t = np.linspace(0.0, 1.0, 11)
        >>> record = Record(t, y=2.0 * (t[:, None] - 0.1))
        >>> observer = observers.Delayed(observers.FilteredDerivative(50.0), delay=0.1, rate=10.0)
        >>> observers.run(observer, record).estimate[-1].round(1).tolist()
        [2.0, 2.0]
    """

    observer: AbstractObserver
    delay: Vector
    lateness: Scalar
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    length: int = eqx.field(static=True)
    waiting: int = eqx.field(static=True)
    ahead: int = eqx.field(static=True)

    def __init__(self, observer: AbstractObserver, delay: Number | Sequence[float], rate: float, lateness: float = 0.0):
        delays = np.atleast_1d(np.asarray(delay, float))
        if delays.ndim != 1 or not (np.isfinite(delays) & (delays >= 0)).all():
            raise InputError(f"Delayed: delay must be a number ≥ 0 [s], or one for each coordinate; got {delay}")
        if not 0 <= lateness < math.inf:
            raise InputError(f"Delayed: lateness must be a number ≥ 0 [s]; got {lateness}")
        if not 0 < rate < math.inf:
            raise InputError(f"Delayed: rate must be a positive number [Hz]; got {rate}")
        check_whole("Delayed", observer)
        self.observer = observer
        self.delay, self.lateness = jnp.asarray(delays), jnp.asarray(float(lateness))
        self.groups = tuple(tuple(np.flatnonzero(delays == d).tolist()) for d in np.unique(delays))
        self.length = _rows(delays.max() + lateness, rate) + 1
        waits = [_rows(delays.max() + lateness - d, rate) for d in np.unique(delays)]
        # One more, since irregular stamps may add one in the same time; readings that never wait need no place.
        self.waiting = sum(rows + 1 for rows in waits if rows)
        self.ahead = _rows(delays.min(), rate)

    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> DelayedState:
        """State at rest at a measured configuration, with empty buffers.

        Args:
            y: First measurement, complete: coordinates (n,), or on a group a matrix (N, N).
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.

        Raises:
            ValueError: The delays do not fit the shape of y, or y is no configuration.
        """
        y = jnp.asarray(y)
        if len(self.delay) > 1 and y.shape != self.delay.shape:
            raise InputError(
                f"Delayed: {len(self.delay)} delays do not fit a measurement of shape {y.shape}; give one for each "
                "coordinate, or a single one, which a group needs"
            )
        now = self.observer.init(y, t)
        real = jnp.real(y).dtype
        # The estimate starts at the time of the latest entry of the configuration; further sensors do not matter.
        of_configuration = self.delay if len(self.delay) == 1 else self.observer.configuration(self.delay)
        longest = jnp.max(of_configuration).astype(real)
        t = jnp.asarray(t, real)
        last_input = now.last_input if "last_input" in now._fields else None
        entries = y.size if self._gathers_start else 0
        rows, stamps = self.waiting, self.length + 2
        return DelayedState(
            now,
            t,
            self.observer.init(y, t - longest),
            longest,
            jnp.full(rows, jnp.inf, real),
            jnp.full((rows, *y.shape), jnp.nan, y.dtype),
            jnp.full(stamps, jnp.inf, real),
            jnp.zeros((stamps, 0 if last_input is None else last_input.shape[0]), real),
            self.delay.astype(real)[:entries],
            y.ravel()[:entries],
            last_input,
        )

    def estimate(self, state: DelayedState) -> Any:
        return self.observer.estimate(state.now)

    def predict(self, state: DelayedState, u: Float[Array, "m"], dt: Scalar) -> DelayedState:
        """Move the time of the state and the ages of all readings by dt; `correct` then runs the inner observer.

        With delays, `estimate` refers to the time before this step until the state is corrected.

        Args:
            state: State after the previous sample.
            u: Input (m,), constant over dt.
            dt: Length of the prediction [s].

        Returns:
            The state with the input in its buffer. Without delays it is predicted by the inner observer at once.
        """
        if self._no_delay:
            return state._replace(now=self.observer.predict(state.now, u, dt), t=state.t + dt)
        # An observer that stores no input has no model and uses none; its log may lack inputs.
        inputs = state.u.shape[1]
        acting = u[:inputs].astype(state.u.dtype) if u.size else jnp.zeros(inputs, state.u.dtype)
        return state._replace(
            t=state.t + dt,
            age_of_known=state.age_of_known + dt,
            age=state.age + dt,
            start_age=state.start_age + dt,
            stamp=jnp.append(state.stamp[1:] + dt, 0.0),
            u=jnp.concatenate([state.u[1:], acting[None]]),
        )

    def correct(self, state: DelayedState, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> tuple[DelayedState, Any]:
        """Correct by a sample whose stamp is the time of the state; coordinate i was true delay[i] earlier.

        Args:
            state: State that `predict` returned.
            u: Input (m,) that acted over the prediction.
            y: Measurement, NaN where missing.

        Returns:
            The state, with the estimate for the time of the stamp, and the info.
        """
        if self._no_delay:
            now, info = self.observer.correct(state.now, u, y)
            return state._replace(now=now, known=now), info
        return self._replay(state, y, jnp.zeros_like(state.t))

    @property
    def _no_delay(self) -> bool:
        """Whether nothing is ever late, so that the result equals the inner observer, to the last bit."""
        return self.length == 1

    def late(self, state: DelayedState, y: Inexact[Array, "*n"], t: Number) -> tuple[DelayedState, Any]:
        """Process a sample that arrives after later samples; its coordinate i was true at t − delay[i].

        Args:
            state: State of this observer.
            y: Measurement, NaN where missing.
            t: Time stamp of the sample [s], at most the time of the state.

        Returns:
            The new state, with the estimate for the same time as before, and the info. A reading that arrives more than
            `lateness` after its delay is left out, and `result` says `TOO_LATE`. If t is later than the state or not
            finite, `result` says `STEP_REFUSED`.
        """
        sample_age = state.t - jnp.asarray(t, state.t.dtype)
        in_past = sample_age > -SAME_TIME
        measured = jnp.where(in_past & jnp.isfinite(y), y, jnp.nan)
        new_state, info = self._replay(state, measured, jnp.where(in_past, jnp.maximum(sample_age, 0.0), 0.0))
        return new_state, info._replace(result=jnp.where(in_past, info.result, int(StepCode.STEP_REFUSED)))

    def _replay(self, state: DelayedState, y: Array, sample_age: Scalar) -> tuple[DelayedState, Any]:
        """The state after a sample whose stamp is `sample_age` [s] old, and the info."""
        inserted = self._insert(state, y, sample_age)
        if not self._gathers_start:
            return self._run_on(state, y, *inserted)
        gathers = jnp.isfinite(state.start_age[0])
        state, inserted = jax.lax.cond(gathers, self._gather_start, lambda *same: same, state, inserted)
        gathers = jnp.isfinite(state.start_age[0])
        return jax.lax.cond(gathers, self._start_anew, self._run_on, state, y, *inserted)

    @property
    def _positions(self) -> np.ndarray:
        """Indices of the positions among the entries of a measurement whose entries have different delays."""
        return np.ravel(self.observer.configuration(np.arange(sum(map(len, self.groups)))))

    @property
    def _gathers_start(self) -> bool:
        """Whether positions have different delays, so that no single sample determines all of them at one time."""
        return len(self.groups) > 1 and sum(bool({*self._positions} & {*group}) for group in self.groups) > 1

    def _gather_start(self, state: DelayedState, inserted: "_Inserted") -> tuple[DelayedState, "_Inserted"]:
        """The state with its first `known`, once the first reading of each position is old enough."""
        age, readings, positions = inserted.age, inserted.readings, self._positions
        longest = jnp.max(self.delay[positions]).astype(age.dtype)
        before = age >= longest - SAME_TIME
        start_age, start_y = _choose_readings(age, readings, before, (state.start_age, state.start_y))
        ready = jnp.all(start_age[positions] >= longest - SAME_TIME)
        nothing = jnp.zeros_like(start_age), jnp.full_like(start_y, jnp.nan)
        later_age, later = _choose_readings(age, readings, ~before, nothing, last=False)
        older = self.observer.init(start_y, state.t - longest)
        # The observer wraps angles; the change is 0 if no later reading exists.
        change = self.observer.innovation(older, state.u[-1], later)
        share = ((start_age - longest) / (start_age - later_age))[positions]
        change = jnp.where(start_age[positions] > longest, share * change, 0.0)
        y = start_y + np.eye(len(start_y))[:, positions].astype(start_y.dtype) @ change
        known = self.observer.init(y, state.t - longest)
        known, age_of_known = jax.tree.map(
            lambda new, old: jnp.where(ready, new, old), (known, longest), (state.known, state.age_of_known)
        )
        start_age = jnp.where(ready, jnp.inf, start_age)
        state = state._replace(known=known, age_of_known=age_of_known, start_age=start_age, start_y=start_y)
        return state, inserted._replace(age=jnp.where(ready & before, jnp.inf, age))

    def _start_anew(
        self, state: DelayedState, y: Array, age: Array, readings: Array, current: Array, too_late: Array
    ) -> tuple[DelayedState, Any]:
        """The state at rest at the latest readings, used until readings for a common time are available."""
        _, latest = _choose_readings(age, readings, jnp.isfinite(age), (state.start_age, state.start_y))
        nothing = jnp.full(y.shape, jnp.nan, y.dtype)
        rest = self.observer.init(latest, state.t)
        now, info = self.observer.advance(rest, state.u[-1], nothing, jnp.zeros_like(state.t))
        complete = jnp.all(jnp.isfinite(self.observer.configuration(y)))
        own = jnp.asarray(info.result)
        code = jnp.where(too_late, int(StepCode.TOO_LATE), jnp.where(complete, int(StepCode.OK), own)).astype(own.dtype)
        recent = slice(len(age) - self.waiting, None)
        return state._replace(now=now, age=age[recent], y=readings[recent]), info._replace(result=code)

    def _run_on(
        self, state: DelayedState, y: Array, age: Array, readings: Array, current: Array, too_late: Array
    ) -> tuple[DelayedState, Any]:
        """The state after the readings in the buffer, starting from the last one that no reading can change."""
        # SAME_TIME is subtracted, so that rounding does not leave a reading at the horizon unsettled.
        horizon = jnp.max(self.delay) + self.lateness - SAME_TIME
        # If there are more readings than the buffer holds, the oldest ones are settled.
        settled = (age >= horizon.astype(age.dtype)) | (jnp.arange(len(age)) < len(age) - self.waiting)
        before = jnp.minimum(jnp.concatenate([state.age_of_known[None], age[:-1]]), state.age_of_known)
        row_u = jax.vmap(lambda a, b: _mean_input(state, a, b))(before, age)
        _, shape = eqx.filter_eval_shape(self.observer.advance, state.known, state.u[0], y, state.t)
        blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
        start = _Replay(state.known, state.age_of_known, state.known, state.age_of_known, blank, _of_now(blank))
        carry, _ = jax.lax.scan(self._scan_reading, start, (age, row_u, readings, current, settled))
        carry = self._to_now(carry, state, y)
        result = jnp.where(too_late, jnp.maximum(carry.info.result, int(StepCode.TOO_LATE)), carry.info.result)
        info = carry.info._replace(result=result, **carry.of_now)
        # The sample added rows, so as many of the oldest or empty ones are removed.
        recent = slice(len(age) - self.waiting, None)
        age = jnp.where(settled, jnp.inf, age)
        new = state._replace(now=carry.state, known=carry.known, age_of_known=carry.age_of_known)
        return new._replace(age=age[recent], y=readings[recent]), info

    def _to_now(self, carry: "_Replay", state: DelayedState, y: Array) -> "_Replay":
        """Predict with the model from the last reading to the stamp, input by input."""
        if not self.ahead:
            return carry
        ages, inputs = state.stamp[-self.ahead :], state.u[-self.ahead :]
        # If samples come faster than `rate`, the first of these predictions covers the inputs that were left out.
        inputs = jnp.concatenate([_mean_input(state, carry.age, ages[0])[None], inputs[1:]])

        def predicted(carry, item):
            age, u = item
            new, info = self.observer.advance(carry.state, u, jnp.full(y.shape, jnp.nan, y.dtype), carry.age - age)
            code = jnp.asarray(info.result, carry.info.result.dtype)
            # The missing measurement here is not a fault.
            worse = jnp.where(code == int(StepCode.NOT_FINITE), jnp.maximum(carry.info.result, code), carry.info.result)
            return carry._replace(state=new, age=age, info=carry.info._replace(result=worse), of_now=_of_now(info))

        def turn(carry, item):
            return jax.lax.cond(item[0] < carry.age, predicted, lambda carry, _: carry, carry, item), None

        return jax.lax.scan(turn, carry, (ages, inputs))[0]

    def _insert(self, state: DelayedState, y: Array, sample_age: Scalar) -> "_Inserted":
        """Insert a sample into the buffer, the oldest reading first; empty entries have age ∞ and come before it.

        Coordinates that were true at the time of a reading in the buffer are added to it.
        """
        age, readings, too_late = state.age, state.y, jnp.asarray(False)
        shape = (1,) if len(self.delay) == 1 else y.shape
        current = jnp.zeros((len(age), *shape), bool)
        for group in self.groups:
            in_group = jnp.zeros(shape, bool).at[jnp.array(group)].set(True)
            part = jnp.where(_with_axes(in_group, y), y, jnp.nan)
            at = sample_age + self.delay[group[0]].astype(age.dtype)
            distance = jnp.abs(age - at)
            same_time = (distance <= SAME_TIME) & (distance == jnp.min(distance, initial=jnp.inf))
            completes = jnp.any(same_time)
            too_old = (at > jnp.minimum(state.age_of_known, state.stamp[0])) & ~completes
            # A reading from before the start has no use, but is not late either: nothing has left the buffer yet.
            lost = too_old & (jnp.isfinite(state.stamp[0]) | (sample_age > 0))
            too_late = too_late | (lost & jnp.any(jnp.isfinite(part)))
            fill = _with_axes(same_time, readings) & jnp.isfinite(part)[None]
            readings, current = jnp.where(fill, part[None], readings), current | (same_time[:, None] & in_group[None])
            at = jnp.where(completes | too_old, jnp.inf, at)
            older = age >= at
            readings, current = _insert_row(readings, part, older), _insert_row(current, in_group, older)
            age = _insert_row(age, at, older)
        return _Inserted(age, readings, current, too_late)

    def _scan_reading(self, carry: "_Replay", item):
        """Process one reading; an empty entry has no effect."""
        return jax.lax.cond(jnp.isfinite(item[0]), self._read, lambda carry, item: carry, carry, item), None

    def _read(self, carry: "_Replay", item) -> "_Replay":
        age, u, y, current, settled = item
        state, info = self.observer.advance(carry.state, u, y, carry.age - age)
        known, age_of_known = jax.tree.map(
            lambda new, old: jnp.where(settled, new, old), (state, age), (carry.known, carry.age_of_known)
        )
        # Only entries that the sample itself lacks count as missing, and not those that are read at other times.
        complete = ~jnp.any(jnp.isnan(y) & _with_axes(current, y))
        code = jnp.where(complete & (info.result == int(StepCode.COASTED)), int(StepCode.OK), info.result)
        counts = jnp.any(current) | (code == int(StepCode.NOT_FINITE))
        before = carry.info.result
        result = jnp.where(counts, jnp.maximum(before, jnp.asarray(code, before.dtype)), before)
        # With one delay there is one flag for all, otherwise one for each entry of a measurement.
        positions = current if len(current) == 1 else self.observer.configuration(current)
        innovation = jnp.where(positions, info.innovation, carry.info.innovation)
        newest = jax.tree.map(lambda new, old: jnp.where(jnp.any(current), new, old), info, carry.info)
        summary = newest._replace(innovation=innovation, result=result)
        sensors: Any = getattr(info, "sensors", None)
        if sensors is not None and len(current) > 1:
            every = Sensors(self.sensors)
            read = every.of(current[-every.size :])
            kept = jax.tree.map(lambda new, old: jnp.where(read, new, old), sensors, carry.info.sensors)
            summary = summary._replace(sensors=kept)
        return _Replay(state, age, known, age_of_known, summary, _of_now(info))


class _Inserted(NamedTuple):
    """The buffer with a sample: ages, readings, flags of the sample's entries, and whether one of them was too old."""

    age: Array
    readings: Array
    current: Array
    too_late: Array


class _Replay(NamedTuple):
    """Data passed from reading to reading: inner state and age, those of the last settled reading, the sample's info.

    `of_now` is the part of the info that describes the last estimate.
    """

    state: Fields
    age: Scalar
    known: Fields
    age_of_known: Scalar
    info: Any
    of_now: dict[str, Any]


def _of_now(info: Any) -> dict[str, Any]:
    """The fields of an info that describe the estimate, not a reading; they change with every prediction."""
    return {name: getattr(info, name) for name in OF_ESTIMATE if getattr(info, name, None) is not None}


def _rows(time: float, rate: float) -> int:
    """Most samples in a time [s]; 1e-9 compensates rounding if time times rate is a whole number."""
    return math.ceil(time * rate - 1e-9)


def _choose_readings(
    age: Float[Array, "L"], y: Array, wanted: Bool[Array, "L"], default: tuple[Array, Array], last: bool = True
) -> tuple[Array, Array]:
    """Age and value of each entry in the last, or the first, of the wanted rows that contain it."""
    there = (wanted & jnp.isfinite(age))[:, None] & jnp.isfinite(y)
    # Rows are numbered from 1 in the order of preference; 0 marks rows without the entry.
    order = np.arange(1.0, len(age) + 1)[:, None]
    rank = jnp.where(there, order if last else order[::-1], 0.0)
    best = jnp.max(rank, axis=0, initial=0.0)
    chosen = there & (rank == best[None])
    ages, values = (jnp.sum(jnp.where(chosen, each, 0.0), axis=0) for each in (age[:, None], y))
    return jnp.where(best > 0, ages, default[0]), jnp.where(best > 0, values, default[1])


def _insert_row(rows: Array, row: Array, older: Bool[Array, "L"]) -> Array:
    """The rows with another row inserted behind those that are `older`, which come first."""
    stays = _with_axes(jnp.pad(older, (0, 1)), rows)
    # The first place is for a row that is older than all others.
    follows = _with_axes(jnp.pad(older, (1, 0), constant_values=True), rows)
    kept, moved = (jnp.concatenate(pair) for pair in ((rows, row[None]), (row[None], rows)))
    return jnp.where(stays, kept, jnp.where(follows, row[None], moved))


def _with_axes(flags: Bool[Array, "k"], like: Array) -> Array:
    """The flags, with axes of length 1 appended, to go with an array of more axes."""
    return flags.reshape(flags.shape + (1,) * (like.ndim - flags.ndim))


def _mean_input(state: DelayedState, start: Scalar, end: Scalar) -> Float[Array, "m"]:
    """Mean of the inputs that acted from the age `start` to the age `end`; the first input also acts before it."""
    since = jnp.concatenate([jnp.full(1, jnp.inf, state.stamp.dtype), state.stamp[:-1]])
    acted = jnp.maximum(jnp.minimum(start, since) - jnp.maximum(end, state.stamp), 0.0)
    total = jnp.sum(acted)
    return jnp.sum((acted / jnp.where(total > 0, total, 1.0))[:, None] * state.u, axis=0)
