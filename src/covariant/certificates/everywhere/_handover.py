"""Unites an observer that is proved to converge from all first errors with a sharper one near the truth.

Both observers take all measurements. After each complete measurement the error x of the proved one satisfies, in the
norm of its certificate,

    |x⁺| ≤ b⁺ = e^(−μτ) b + (1 − e^(−μτ)) r,   and   |x⁺| ≤ |(ω(|q̂ − y| + n), |v̂| + V)|,

the second by the measurement and the bound V of the true speeds alone. So b is known from the first sample on, and
again from the first sample after a premise failed: a time for which nothing is proved, or an estimate that is farther
from the measurement, or faster than V, than b allows. If b falls below a level d, the sharper observer is reported for
as long as the two are at most b + d apart; if it is farther away at that time, it starts anew at the estimate of the
proved one. By the triangle inequality the reported error is at most b plus the distance of the two, whatever the
sharper observer does.

Each return because of the distance halves d, so that there are at most 1 + log₂(d/b) of them, with the first d:
finitely many if r > 0, and otherwise in the long run one in the time ln 2/μ.

Source: Astolfi, Postoyan & Nešić 2017, Uniting local and global observers for the state estimation of nonlinear
continuous-time systems, IEEE CDC; Hespanha & Morse 1999, Stability of switched systems with average dwell-time.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._typing import Code, Number, Scalar, Vector
from covariant.models import MechanicalSystem
from covariant.observers import AbstractObserver, MeasuredCoefficients, with_velocity, without_last_input
from covariant.observers.base import check_whole, time_since_measurement
from covariant.signals import StepCode
from scalargraph.errors import InputError

ROUND = 1e-9
"""Margin for rounding, relative to a bound, and as a fraction of the level the least bound."""


class HandoverState(NamedTuple):
    """State of a `Handover`.

    Attributes:
        inner: state of the proved observer.
        sharp: state of the sharper one.
        bound: bound b of the proved observer's error after the last complete measurement.
        level: d, below which b has to be.
        holds: 1 while the sharper estimate is reported, else 0.
        last_input: the last finite input (m,).
    """

    inner: Any
    sharp: Any
    bound: Scalar
    level: Scalar
    holds: Scalar
    last_input: Float[Array, "m"] | None = None


class HandoverInfo(NamedTuple):
    """Diagnostics of a step of a `Handover`.

    Attributes:
        innovation: innovation (n,) of the estimate that was reported before.
        position_bound: bound (n,) of the error of each reported position, infinite without a complete measurement.
        velocity_bound: the same of each velocity.
        holds: whether the sharper estimate is reported.
        result: a `StepCode` code of the reported observer.
    """

    innovation: Vector
    position_bound: Vector
    velocity_bound: Vector
    holds: Scalar
    result: Code


class Handover(AbstractObserver):
    """A proved observer that hands over to a sharper one near the truth, with a proved bound of what is reported.

    Attributes:
        observer: the proved observer.
        sharp: the sharper observer, such as `Intrinsic`, or a Kalman filter behind its gate.
        form: matrix (2n, 2n) of the squared norm of errors of positions and velocities.
        reach: bounds (2n,) of these errors at a norm of 1.
        limits: bounds (2n,) of the errors of measurements, and of the true speeds.
        ages: least and largest ages (p, 2) of a measurement at the next one.
        rate: μ [1/s].
        radius: r.
        level: d at the start.
    """

    observer: MeasuredCoefficients
    sharp: Any
    form: Array
    reach: Array
    limits: Array
    ages: Array
    rate: Array
    radius: Array
    level: Array

    def __check_init__(self):
        check_whole("hand_over", self.sharp)
        other = getattr(self.sharp, "model", None)
        if other is None or other.coordinates != self.model.coordinates or self.sharp.sensors:
            raise InputError("hand_over: the sharper observer must have the same coordinates, and no more sensors")

    fixed_numbers = True

    @property
    def model(self) -> MechanicalSystem:
        """The mechanical system of the proved observer."""
        return self.observer.model

    def init(self, y: Array, t: Number = 0.0) -> HandoverState:
        first = self.observer.init(y, t)
        inner, holds = without_last_input(first), jnp.zeros_like(self.level)
        return HandoverState(inner, self._start(inner), self._by_data(inner), self.level, holds, first.last_input)

    def estimate(self, state: HandoverState) -> Any:
        return jnp.where(state.holds > 0, self.sharp.estimate(state.sharp), self.observer.estimate(state.inner))

    def predict(self, state: HandoverState, u: Float[Array, "m"], dt: Scalar) -> HandoverState:
        inner, sharp = self.observer.predict(state.inner, u, dt), self.sharp.predict(state.sharp, u, dt)
        return state._replace(inner=inner, sharp=sharp)

    def correct(self, state: HandoverState, u: Float[Array, "m"], y: Array) -> tuple[HandoverState, HandoverInfo]:
        inner, info = self.observer.correct(state.inner, u, y)
        sharp, sharp_info = self.sharp.correct(state.sharp, u, y)
        missing = self.model.manifold.missing(y)
        # Nothing is known of a second measurement at the same time.
        complete = ~jnp.any(missing) & (time_since_measurement(state.inner) > 0)
        lost, held = jnp.all(missing), state.holds > 0
        now, confirmed = self._bound(state, inner)
        apart = self._apart(inner, sharp)
        valid = jnp.isfinite(apart) & (sharp_info.result < int(StepCode.NOT_FINITE))
        near = valid & (apart <= now + state.level)
        # A row without any measurement changes nothing; of one with some of them nothing is known.
        stays = held & jnp.where(complete, confirmed & near, lost & valid)
        holds = stays | (complete & confirmed & ~held & (now <= state.level))
        # Until then the sharper observer runs on its own, and keeps what it has learnt unless it is lost.
        anew = ~valid | (holds & ~stays & ~near)
        sharp = jax.tree.map(lambda start, new: jnp.where(anew, start, new), self._start(inner), sharp)
        level = jnp.where(held & complete & confirmed & ~near, state.level / 2, state.level)
        bound = jnp.where(complete, now, jnp.where(lost, state.bound, jnp.inf))
        as_it_is = holds & ~anew
        reported = jnp.where(complete, now + jnp.where(as_it_is, apart, 0.0), jnp.inf) * self.reach
        position, velocity = jnp.split(reported, 2)
        result: Any = jnp.where(as_it_is, sharp_info.result, info.result)
        after = HandoverState(inner, sharp, bound, level, holds.astype(level.dtype), state.last_input)
        innovation: Any = jnp.where(held, sharp_info.innovation, info.innovation)
        return after, HandoverInfo(innovation, position, velocity, after.holds, result.astype(info.result.dtype))

    def _start(self, inner: Any) -> Any:
        """The state of the sharper observer at the estimate of the proved one."""
        return without_last_input(with_velocity(self.sharp.init(inner.q, inner.t), inner.v))

    def _bound(self, state: HandoverState, inner: Any) -> tuple[Scalar, Array]:
        """The bound b after a complete measurement, and whether that confirms what followed from the one before."""
        age = time_since_measurement(state.inner)
        kept = jnp.exp(-self.rate * age)
        # The least bound is far above what rounding changes.
        followed = jnp.maximum(kept * state.bound + (1 - kept) * self.radius, ROUND * self.level) * (1 + ROUND)
        known = jnp.any((self.ages[:, 0] <= age) & (age <= self.ages[:, 1]))
        confirmed = known & jnp.all(self._seen(inner) <= followed * self.reach + self.limits)
        return jnp.minimum(jnp.where(confirmed, followed, jnp.inf), self._by_data(inner)), confirmed

    def _seen(self, inner: Any) -> Vector:
        """Sizes (2n,) of the error towards the measurement, and of the velocity."""
        return jnp.abs(jnp.concatenate([inner.q - inner.seen, inner.v]))

    def _by_data(self, inner: Any) -> Scalar:
        """The bound that follows from the measurement alone, for the largest true speeds."""
        largest = self._seen(inner) + self.limits
        return jnp.sqrt(largest @ jnp.abs(self.form) @ largest) * (1 + ROUND)

    def _apart(self, inner: Any, sharp: Any) -> Scalar:
        """Norm of the difference of the two estimates."""
        q, v = self.model.motion(self.sharp.estimate(sharp))
        difference = jnp.concatenate([self.model.manifold.towards(inner.q, q), v - inner.v])
        return jnp.sqrt(difference @ self.form @ difference)
