"""A proved bound of the estimation error after every sample: the recursion of a certificate, run with its observer.

The certificate of a sampled observer shows how the distance between truth and estimate, in its metric, changes from
sample to sample (see `_radius_recursion`). Run on a log or in real time, this recursion gives a radius after every
sample. The radius bounds the error of each position and velocity. If a sample does not confirm a premise of the
certificate, the bounds are infinite and name that premise, until the caller gives a new start.
"""

import enum
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from covariant._typing import Code, Number, Scalar, Vector
from covariant.certificates.base import Recursion
from covariant.signals import StepCode, largest_measurement

ROUND = 1e-9
"""Relative margin that covers the rounding of the recursion, which runs in doubles."""
TURN = 2 * np.pi


class Premise(enum.IntEnum):
    """Whether a bound is known, and otherwise the premise of the certificate that fails.

    Example:
        >>> from covariant.certificates import Premise
        >>> Premise(2).name, Premise.AGE.message
        ('AGE', 'a step, or the time since the last measurement, is of a length for which nothing is proved')
    """

    HOLDS = 0
    START = 1
    AGE = 2
    TUBE = 3
    VELOCITY = 4
    POSITION = 5
    INPUT = 6
    MEASUREMENT = 7
    STEP = 8

    @property
    def message(self) -> str:
        """One line that says which premise is not known to hold."""
        return _MESSAGES[self]


_MESSAGES = {
    Premise.HOLDS: "the bound is proved",
    Premise.START: "no bound of the initial error was given, or it exceeds the radius of the certificate",
    Premise.AGE: "a step, or the time since the last measurement, is of a length for which nothing is proved",
    Premise.TUBE: "the error may be beyond the radius of the certificate",
    Premise.VELOCITY: "the velocity may be beyond the bound of the certificate",
    Premise.POSITION: "the position may be outside of the region of the certificate",
    Premise.MEASUREMENT: "only some positions were measured or used, for which nothing is proved",
    Premise.INPUT: "the input is outside of the bounds of the certificate, or not finite",
    Premise.STEP: "the certificate does not cover what the observer's step did, such as a restart: see its result code",
}


class BoundState(NamedTuple):
    """State of the bound between samples.

    Attributes:
        radius: proved distance right after the last measurement, in the metric; infinite where nothing is known.
        age: time since that measurement [s].
        premise: `Premise` as a number: 0, or the first one that failed. It is a real number like the other fields,
            since `lowering` needs states of real numbers.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates import BoundState
        >>> BoundState(jnp.array(0.02), jnp.zeros(()), jnp.zeros(())).radius.item()
        0.02
    """

    radius: Scalar
    age: Scalar
    premise: Scalar


class BoundInfo(NamedTuple):
    """The bound after a sample.

    Attributes:
        radius: proved distance between truth and estimate, in the metric of the present age.
        position: bound (n,) of the error of each position [unit].
        velocity: bound (n,) of the error of each velocity [unit/s].
        premise: `Premise` as an integer; the bounds are infinite unless it is 0.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates import BoundInfo, Premise
        >>> unknown = jnp.array([jnp.inf])
        >>> info = BoundInfo(unknown[0], unknown, unknown, jnp.array(2))
        >>> Premise(int(info.premise)).name
        'AGE'
    """

    radius: Scalar
    position: Vector
    velocity: Vector
    premise: Code


class SampledBound(eqx.Module):
    """A proved error bound after every sample of an observer with sampled measurements; from `certificate.bound()`.

    The bound rests on the assumptions of the certificate, above all that noise and unknown force are within the bounds
    that it states. Each step checks what a sample shows: the age of the measurement, the input, and that every state
    within the bound is in the region of positions and within the bounds of velocity. Between samples the last is
    assumed.

    Use it beside an observer, to know at every sample how far the estimate may be off: for a safety monitor rather than
    for a design. The bound is a worst case, so that it exceeds the usual error many times; a filter reports standard
    deviations.

    Attributes:
        recursion: constants of the recursion.
        radius: ε of the certificate.
        reach: bounds (2n,) of each position and velocity error at a distance of 1.
        start: weights (2n,) of the squared initial errors in the squared distance; ∞ where the certificate has none.
        positions: least and largest true positions (2, n).
        velocity: bounds (n,) of the true velocities.
        inputs: least and largest inputs (2, m).
        circles: which positions are angles on a circle (n,).

    Example:
        The bound of a certificate with the rate μ = 2 1/s and an encoder, whose errors add 1e-6 to squared distances:

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import Premise, SampledBound
        >>> from covariant.certificates.base._radius_recursion import Recursion
        >>> recursion = Recursion(2.0, 0.0, (1e-6,), 0.0, 0.0, 0.0, np.array([[0.01, 0.02]]))
        >>> region = np.array([[-3.0], [3.0]]), np.array([4.0]), np.array([[-1.0], [1.0]])
        >>> bound = SampledBound(recursion, 0.1, np.array([1.0, 10.0]), np.array([2.0, 0.02]), *region, (False,))
        >>> state = bound.init(0.05)
        >>> x, u, y = jnp.array([0.2, 1.0]), jnp.zeros(1), jnp.array([0.2])
        >>> state, info = bound.step(state, x, u, y, 0.01)
        >>> info.position.round(4).tolist(), info.velocity.round(3).tolist(), Premise(int(info.premise)).name
        ([0.049], [0.49], 'HOLDS')
        >>> bound.step(state, x, u, y, 0.5)[1].velocity.tolist()  # too late for the certificate
        [inf]
    """

    recursion: Recursion
    radius: float
    reach: Float[np.ndarray, "two_n"]
    start: Float[np.ndarray, "two_n"]
    positions: Float[np.ndarray, "2 n"]
    velocity: Float[np.ndarray, "n"]
    inputs: Float[np.ndarray, "2 m"]
    circles: tuple[bool, ...] = eqx.field(static=True)

    def init(self, radius: Number = np.inf) -> BoundState:
        """Start from a bound of the distance, right after a measurement.

        Args:
            radius: largest distance between truth and estimate, in the metric of the certificate; unknown by default.

        Returns:
            The state. Its radius is infinite if `radius` is negative, NaN, or above that of the certificate.
        """
        start = jnp.asarray(radius, float)
        known = (start >= 0) & (start <= self.radius)
        premise = jnp.where(known, 0.0, float(Premise.START))
        return BoundState(jnp.where(known, start, jnp.inf), jnp.zeros(()), premise)

    def within(self, position: ArrayLike, velocity: ArrayLike) -> BoundState:
        """Start from bounds of the initial errors, right after a measurement.

        Args:
            position: bounds (n,) of the errors of the positions [unit], or one for all.
            velocity: bounds (n,) of the errors of the velocities [unit/s], or one for all.

        Returns:
            The state. Its radius is infinite if these errors may exceed the radius of the certificate.
        """
        each = [jnp.broadcast_to(jnp.asarray(b, float), self.velocity.shape) for b in (position, velocity)]
        return self.init(jnp.sqrt(jnp.sum(jnp.asarray(self.start) * jnp.concatenate(each) ** 2)) * (1 + ROUND))

    def step(
        self,
        state: BoundState,
        x: Float[Array, "two_n"],
        u: Float[Array, "m"],
        y: Float[Array, "n"],
        dt: Number,
        result: Code | Number | None = None,
    ) -> tuple[BoundState, BoundInfo]:
        """Advance the bound over a sample.

        A measurement that the observer did not use, since it is missing, infinite, too large or refused by a gate,
        corrects nothing here either. It counts as a lost sample, and the bound stays known only if the certificate
        covers the age that results.

        Args:
            state: the state after the previous sample.
            x: the estimate (2n,) after this sample, positions first.
            u: the input (m,) since the previous sample.
            y: the measurement (n,) as the observer got it; NaN where it is lost.
            dt: time since the previous sample [s]; 0, a repeated stamp, changes nothing. A time longer than the
                interval of the certificate is not covered: pass every lost sample too, with NaN as y.
            result: result code of the observer's step, `info.result`. By default it is computed from the other
                arguments, for the certified observer itself without a gate.

        Returns:
            The state, and the bound after the sample.
        """
        dt = jnp.asarray(dt, float)
        classified = self._classify(jnp.asarray(y), dt, result)
        measured = classified.used
        age = state.age + jnp.where(classified.repeated, 0.0, dt)
        before = self.recursion.predicted(state.radius, age, jnp) * (1 + ROUND)
        added, known_age = self._noise(age)
        # The term hD(a + β) of the recursion.
        factor_term = self.recursion.change * age * (before + self.recursion.error)
        after = (jnp.sqrt(before**2 + added) + factor_term) * (1 + ROUND)
        radius = jnp.where(measured, after, before)
        # A prediction in one step over lost samples has longer Runge–Kutta steps than those of the proof.
        short = classified.repeated | (dt >= 0) & (dt <= self.recursion.ages[0, 1])
        aged = short & jnp.where(measured, known_age, age <= self.recursion.ages[-1, 1])
        position, velocity = jnp.split(radius * jnp.asarray(self.reach) * (1 + ROUND), 2)
        q, v = jnp.split(x, 2)
        conditions: tuple[tuple[Premise, Any], ...] = (
            (Premise.START, jnp.isfinite(state.radius)),
            (Premise.AGE, aged),
            # Between samples the bound is at most the larger of those before and after the measurement.
            (Premise.TUBE, (before <= self.radius) & (after <= self.radius) | ~measured & (before <= self.radius)),
            (Premise.VELOCITY, (jnp.abs(v) + velocity <= self.velocity).all()),
            (Premise.POSITION, self._inside(q, position).all()),
            (Premise.INPUT, ((self.inputs[0] <= u) & (u <= self.inputs[1])).all()),
            (Premise.STEP, classified.proved),
            (Premise.MEASUREMENT, classified.whole),
        )
        premise = jnp.zeros((), jnp.int32)
        for code, holds in reversed(conditions):
            premise = jnp.where(jnp.asarray(holds), premise, int(code))
        premise = jnp.where(state.premise > 0, state.premise.astype(jnp.int32), premise)
        known = premise == 0
        radius, position, velocity = (jnp.where(known, each, jnp.inf) for each in (radius, position, velocity))
        # A measurement stores the new radius with age 0; without one, the last radius stays and its age grows.
        stored = jnp.where(measured, radius, jnp.where(known, state.radius, jnp.inf))
        new = BoundState(stored, jnp.where(measured, 0.0, age), premise.astype(stored.dtype))
        return new, BoundInfo(radius, position, velocity, premise)

    def _classify(self, y: Float[Array, "n"], dt: Scalar, result: Any) -> "_Classified":
        """Classify what the observer's step did with a measurement, by its result code if there is one."""
        tiny, scalar = jnp.finfo(dt.dtype).tiny, len(self.circles) == 1
        # The same bounds as in `AbstractObserver.step`; false for NaN.
        admitted = jnp.abs(y) <= largest_measurement(y, [i for i, circle in enumerate(self.circles) if circle])
        every, none = admitted.all(), ~admitted.any()
        advanced, repeated = jnp.isfinite(dt) & (dt >= tiny), jnp.abs(dt) < tiny
        if result is None:
            used, unused, proved = every, none, jnp.ones((), bool)
        else:
            corrected, coasted, outlier, again = (jnp.asarray(result) == int(code) for code in _COVERED)
            refused = coasted | outlier
            # With several positions, a code does not say which of them were used.
            used, unused, proved = every & corrected, refused & (none | scalar), corrected | refused | again & repeated
        return _Classified(advanced & used, repeated | ~advanced | used | unused, repeated, proved)

    def _noise(self, age: Scalar) -> tuple[Scalar, Array]:
        """Noise term G of a measurement of this age, and whether the certificate covers this age."""
        ages = jnp.asarray(self.recursion.ages)
        fits = (ages[:, 0] <= age) & (age <= ages[:, 1])
        # If several numbers of lost samples give this age, each is proved, so the least G holds.
        return jnp.min(jnp.where(fits, jnp.asarray(self.recursion.noise), jnp.inf)), fits.any()

    def _inside(self, q: Vector, error: Vector) -> Array:
        """Whether positions with these errors are within the region (n,)."""
        low, high = self.positions
        circle = jnp.asarray(self.circles)
        middle = (low + high) / 2
        wrapped = jnp.where(circle, q - TURN * jnp.floor((q - middle) / TURN + 0.5), q)
        full_circle = circle & (high - low >= TURN)
        return full_circle | (low <= wrapped - error) & (wrapped + error <= high)


class _Classified(NamedTuple):
    """Whether a step used a whole measurement, used all or none of it, repeated a stamp, and is proved."""

    used: Array
    whole: Array
    repeated: Array
    proved: Array


_COVERED = StepCode.OK, StepCode.COASTED, StepCode.OUTLIER, StepCode.REPEATED
"""Result codes of steps that the proof covers: a correction, two for a lost measurement, and a repeated stamp."""
