"""Sensors that tell late: readings are taken in at the times at which they were true, and the estimate is for now.

Coordinate i of the sample with the stamp t was true at t − d_i. The state is kept where nothing older can arrive any
more, at t − max d; what has been read since waits in a buffer. A sample is sorted into the buffer at its true times,
the buffer is run through again in their order, and the model predicts from the last of them to the stamp.

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
from covariant.observers._protocol import AbstractObserver, Held
from covariant.signals import Result

SAME_TIME = 1e-6
"""Times [s] closer than this are one: two coordinates that were true then are taken in together."""


class DelayedState(NamedTuple):
    """An observer's states where everything is known and now, and what has been read between.

    Ages [s] are counted back from now; infinity marks an entry of a buffer that is empty.

    - `now`: the observer's state at the time t [s], and `held` the last finite input.
    - `known`: its state `known_age` ago, which no reading will change any more.
    - `age` (L,), `y` (L, *n): readings since, the oldest first; NaN where a coordinate was not read then.
    - `stamp` (M,), `u` (M, m): ages of the last stamps, the oldest first, and the inputs that acted up to each.
    """

    now: Any
    t: Scalar
    known: Any
    known_age: Scalar
    age: Float[Array, "L"]
    y: Inexact[Array, "L *n"]
    stamp: Float[Array, "M"]
    u: Float[Array, "M m"]
    held: Held = None


class Delayed(AbstractObserver):
    """Any observer, for sensors whose readings are late.

    - `observer`: the observer that takes the readings in, in the order of the times at which they were true.
    - `delay` [s]: coordinate i of a sample with the stamp t was true at t − delay[i]. One number for all coordinates,
      as it must be on a group, or one for each.
    - `rate` [Hz]: the most samples in a second, by which the length of the buffers is chosen.
    - `lateness` [s]: how much later than its delay says a sample may arrive; see `late`.

    Between two readings the mean of the inputs over that time acts. Where samples come faster than `rate`, the buffers
    reach back too short a time: a reading that is older is left out, and `result` says `TOO_LATE`. The info is that of
    the newest reading of a sample, with the innovations of all its readings and, where the observer has some, the
    standard deviations of the estimate now.

    Raises `ValueError` for delays and a lateness that are not finite and ≥ 0, and a rate that is not positive.
    """

    observer: AbstractObserver
    delay: Vector
    lateness: Scalar
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    length: int = eqx.field(static=True)

    def __init__(self, observer: AbstractObserver, delay: Number | Sequence[float], rate: float, lateness: float = 0.0):
        delays = np.atleast_1d(np.asarray(delay, float))
        if delays.ndim != 1 or not (np.isfinite(delays) & (delays >= 0)).all():
            raise ValueError(f"Delayed: delay must be a number ≥ 0 [s], or one for each coordinate; got {delay}")
        if not 0 <= lateness < math.inf:
            raise ValueError(f"Delayed: lateness must be a number ≥ 0 [s]; got {lateness}")
        if not 0 < rate < math.inf:
            raise ValueError(f"Delayed: rate must be a positive number [Hz]; got {rate}")
        self.observer = observer
        self.delay, self.lateness = jnp.asarray(delays), jnp.asarray(float(lateness))
        self.groups = tuple(tuple(np.flatnonzero(delays == d).tolist()) for d in np.unique(delays))
        self.length = math.ceil((delays.max() + lateness) * rate - 1e-9) + 1

    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> DelayedState:
        y = jnp.asarray(y)
        if len(self.delay) > 1 and y.shape != self.delay.shape:
            raise ValueError(
                f"Delayed: {len(self.delay)} delays do not fit a measurement of shape {y.shape}; give one for each "
                "coordinate, or a single one, which a group needs"
            )
        now = self.observer.init(y, t)
        real = jnp.real(y).dtype
        longest = jnp.max(self.delay).astype(real)
        t = jnp.asarray(t, real)
        held = getattr(now, "held", None)
        rows, stamps = self.length * len(self.groups), self.length + 2
        return DelayedState(
            now,
            t,
            self.observer.init(y, t - longest),
            longest,
            jnp.full(rows, jnp.inf, real),
            jnp.full((rows, *y.shape), jnp.nan, y.dtype),
            jnp.full(stamps, jnp.inf, real),
            jnp.zeros((stamps, 0 if held is None else held.shape[0]), real),
            held,
        )

    def admitted(self, y: Inexact[Array, "*n"]) -> Inexact[Array, "*n"]:
        return self.observer.admitted(y)

    def estimate(self, state: DelayedState) -> Any:
        return self.observer.estimate(state.now)

    def predict(self, state: DelayedState, u: Float[Array, "m"], dt: Scalar) -> DelayedState:
        if self._waits_for_none:
            return state._replace(now=self.observer.predict(state.now, u, dt), t=state.t + dt)
        # An observer that holds no input knows no model, and makes no use of one; a log need not have any.
        held = state.u.shape[1]
        acting = u[:held].astype(state.u.dtype) if u.size else jnp.zeros(held, state.u.dtype)
        return state._replace(
            t=state.t + dt,
            known_age=state.known_age + dt,
            age=state.age + dt,
            stamp=jnp.append(state.stamp[1:] + dt, 0.0),
            u=jnp.concatenate([state.u[1:], acting[None]]),
        )

    def correct(self, state: DelayedState, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> tuple[DelayedState, Any]:
        if self._waits_for_none:
            now, info = self.observer.correct(state.now, u, y)
            return state._replace(now=now, known=now), info
        return self._replayed(state, y, jnp.zeros_like(state.t))

    @property
    def _waits_for_none(self) -> bool:
        """Whether nothing is ever late: it is the observer itself then, to the last bit."""
        return self.length == 1

    def late(self, state: DelayedState, y: Inexact[Array, "*n"], t: Number) -> tuple[DelayedState, Any]:
        """Take in a sample that arrives after later ones: its coordinate i was true at t − delay[i].

        NaN in y marks what is missing. Returns the new state, its estimate for the same time as before, and the info.
        What is more than `lateness` later than its delay is left out, and `result` says `TOO_LATE`; it says
        `STEP_REFUSED` of a time t that is later than that of the state, or not finite.
        """
        ago = state.t - jnp.asarray(t, state.t.dtype)
        past = ago > -SAME_TIME
        measured = jnp.where(past & jnp.isfinite(y), y, jnp.nan)
        moved, info = self._replayed(state, measured, jnp.where(past, jnp.maximum(ago, 0.0), 0.0))
        return moved, info._replace(result=jnp.where(past, info.result, int(Result.STEP_REFUSED)))

    def _replayed(self, state: DelayedState, y: Array, ago: Scalar) -> tuple[DelayedState, Any]:
        """The state with a sample taken in whose stamp is `ago` [s] old, and the info."""
        age, readings, fresh, refused = self._sorted_in(state, y, ago)
        horizon = jnp.max(self.delay) + self.lateness - SAME_TIME
        # There is room for so many readings: what is older is settled.
        settled = (age >= horizon.astype(age.dtype)) | (jnp.arange(len(age)) < len(self.groups))
        before = jnp.minimum(jnp.concatenate([state.known_age[None], age[:-1]]), state.known_age)
        row_u = jax.vmap(lambda a, b: _mean_input(state, a, b))(before, age)
        # From the last reading the model runs on, input by input, to the stamp.
        last = jnp.minimum(state.known_age, jnp.min(age))
        ahead = jnp.where(state.stamp < last, state.stamp, jnp.inf)
        none = jnp.zeros((len(ahead), fresh.shape[1]), bool)
        items = (
            jnp.concatenate([age, ahead]),
            jnp.concatenate([row_u, state.u]),
            jnp.concatenate([readings, jnp.full((len(ahead), *y.shape), jnp.nan, y.dtype)]),
            jnp.concatenate([fresh, none]),
            jnp.concatenate([settled, none[:, 0]]),
        )
        _, shape = eqx.filter_eval_shape(self.observer.step, state.known, state.u[0], y, state.t)
        blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
        start = (state.known, state.known_age, state.known, state.known_age, blank, blank)
        (now, _, known, known_age, said, latest), _ = jax.lax.scan(self._taken, start, items)
        result = jnp.where(refused, jnp.maximum(said.result, int(Result.TOO_LATE)), said.result)
        said = said._replace(result=result)
        if "velocity_std" in said._fields:
            said = said._replace(velocity_std=latest.velocity_std)
        kept = slice(len(self.groups), None)
        age = jnp.where(settled, jnp.inf, age)
        return state._replace(now=now, known=known, known_age=known_age, age=age[kept], y=readings[kept]), said

    def _sorted_in(self, state: DelayedState, y: Array, ago: Scalar):
        """Ages and readings with the sample among them, the oldest first; which entries are its own; was one too old.

        Coordinates that were true at the time of a reading already there complete it.
        """
        age, readings, refused = state.age, state.y, jnp.asarray(False)
        shape = (1,) if len(self.delay) == 1 else y.shape
        fresh = jnp.zeros((len(age), *shape), bool)
        for group in self.groups:
            mine = jnp.zeros(shape, bool).at[jnp.array(group)].set(True)
            part = jnp.where(_over(mine, y), y, jnp.nan)
            at = ago + self.delay[group[0]].astype(age.dtype)
            apart = jnp.abs(age - at)
            there = (apart <= SAME_TIME) & (jnp.arange(len(age)) == jnp.argmin(apart))
            too_old = (at > jnp.minimum(state.known_age, state.stamp[0])) & ~jnp.any(there)
            refused = refused | (too_old & jnp.any(jnp.isfinite(part)))
            fill = _over(there, readings) & jnp.isfinite(part)[None]
            readings = jnp.concatenate([jnp.where(fill, part[None], readings), part[None]])
            age = jnp.append(age, jnp.where(jnp.any(there) | too_old, jnp.inf, at))
            fresh = jnp.concatenate([fresh | (there[:, None] & mine[None]), mine[None]])
        order = jnp.argsort(-age)
        return age[order], readings[order], fresh[order], refused

    def _taken(self, carry, item):
        """One reading taken in, or one prediction; nothing where the entry is empty."""
        return jax.lax.cond(jnp.isfinite(item[0]), self._step, lambda carry, item: carry, carry, item), None

    def _step(self, carry, item):
        state, at, known, known_age, said, _ = carry
        age, u, y, fresh, settled = item
        state, info = self.observer.step(state, u, y, at - age)
        known, known_age = jax.tree.map(lambda new, old: jnp.where(settled, new, old), (state, age), (known, known_age))
        # That the other coordinates are read at other times is no fault: only what the sample lacks is missing.
        whole = ~jnp.any(jnp.isnan(y) & _over(fresh, y))
        code = jnp.where(whole & (info.result == int(Result.COASTED)), int(Result.OK), info.result)
        counts = jnp.any(fresh) | (code == int(Result.NOT_FINITE))
        result = jnp.where(counts, jnp.maximum(said.result, jnp.asarray(code, said.result.dtype)), said.result)
        innovation = jnp.where(fresh, info.innovation, said.innovation)
        newest = jax.tree.map(lambda new, old: jnp.where(jnp.any(fresh), new, old), info, said)
        said = newest._replace(innovation=innovation, result=result)
        return state, age, known, known_age, said, info


def _over(flags: Bool[Array, "k"], like: Array) -> Array:
    """The flags, with axes of length 1 appended, to go with an array of more axes."""
    return flags.reshape(flags.shape + (1,) * (like.ndim - flags.ndim))


def _mean_input(state: DelayedState, start: Scalar, end: Scalar) -> Float[Array, "m"]:
    """Mean of the inputs that acted from the age `start` to the age `end`; before the first, the first acts."""
    since = jnp.concatenate([jnp.full(1, jnp.inf, state.stamp.dtype), state.stamp[:-1]])
    acted = jnp.maximum(jnp.minimum(start, since) - jnp.maximum(end, state.stamp), 0.0)
    total = jnp.sum(acted)
    return jnp.sum((acted / jnp.where(total > 0, total, 1.0))[:, None] * state.u, axis=0)
