"""A proved bound of the estimate's error beside every sample: the recursion of a certificate, run with its observer.

The certificate of a sampled observer shows how the distance between truth and estimate, in its metric, changes from
sample to sample (see `_radius_recursion`). Run on a log, or in real time, this recursion gives a radius after every
sample, and the radius a bound of each position and velocity. It knows nothing (the bounds are infinite, with a reason)
where a premise of the certificate is not seen to hold, from then on until a new start is given.
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
        """One line that says what is not known to hold."""
        return _MESSAGES[self]


_MESSAGES = {
    Premise.HOLDS: "the bound is proved",
    Premise.START: "no bound of the start was given, or one beyond the radius of the certificate",
    Premise.AGE: "a step, or the time since the last measurement, is of a length for which nothing is proved",
    Premise.TUBE: "the error may be beyond the radius of the certificate",
    Premise.VELOCITY: "the velocity may be beyond the bound of the certificate",
    Premise.POSITION: "the position may be outside of the region of the certificate",
    Premise.MEASUREMENT: "only some positions were measured or used, for which nothing is proved",
    Premise.INPUT: "the input is outside of the bounds of the certificate, or not finite",
    Premise.STEP: "the observer's step did what nothing is proved of, such as a new start: see its result code",
}


class BoundState(NamedTuple):
    """What the next step needs.

    Attributes:
        radius: proved distance right after the last measurement, in the metric; infinite where nothing is known.
        age: time since that measurement [s].
        premise: `Premise` as a number: 0, or the first one that failed. All of a state are real numbers, as those that
            `lowering` reads have to be.

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
    """A proved bound beside every sample of an observer with sampled measurements; from `certificate.bound()`.

    What the certificate assumes is assumed here too, the noise and unknown force within the bounds that it states above
    all. What can be seen from a sample is checked: the age of the measurement, the input, and that every state within
    the bound keeps to the region of positions and the bounds of velocity. Between samples the last is assumed.

    Use it beside an observer, to know at every sample how far the estimate may be off: for a safety monitor rather than
    for a design. The bound is a worst case, so that it exceeds the usual error many times; a filter reports standard
    deviations.

    Attributes:
        recursion: the numbers of the recursion.
        radius: ε of the certificate.
        reach: bounds (2n,) of each position and velocity error at a distance of 1.
        start: weights (2n,) of the squared errors of a start; ∞ where the certificate has none.
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
        """Begin with a bound of the distance, right after a measurement.

        Args:
            radius: largest distance between truth and estimate, in the metric of the certificate; unknown by default.

        Returns:
            The state, which knows nothing where the radius is not below that of the certificate.
        """
        start = jnp.asarray(radius, float)
        known = (start >= 0) & (start <= self.radius)
        premise = jnp.where(known, 0.0, float(Premise.START))
        return BoundState(jnp.where(known, start, jnp.inf), jnp.zeros(()), premise)

    def within(self, position: ArrayLike, velocity: ArrayLike) -> BoundState:
        """Begin with bounds of the initial errors, right after a measurement.

        Args:
            position: bounds (n,) of the errors of the positions [unit], or one for all.
            velocity: bounds (n,) of the errors of the velocities [unit/s], or one for all.

        Returns:
            The state, which knows nothing where these errors may be beyond the radius of the certificate.
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
        corrects nothing here either: its sample is lost, which the ages of the certificate cover or not.

        Args:
            state: the state after the sample before.
            x: the estimate (2n,) after this sample, positions first.
            u: the input (m,) since the sample before.
            y: the measurement (n,) as the observer got it; NaN where it is lost.
            dt: time since the sample before [s]; a sample that repeats a stamp (0) changes nothing. One that is longer
                than the interval of the certificate is not covered: give a sample that is lost as one of its own.
            result: result code of the observer's step, `info.result`. By default it is that of the certified observer
                itself, without a gate, which follows from the other arguments.

        Returns:
            The state, and the bound after the sample.
        """
        dt = jnp.asarray(dt, float)
        judged = self._judged(jnp.asarray(y), dt, result)
        measured = judged.used
        age = state.age + jnp.where(judged.repeated, 0.0, dt)
        before = self.recursion.predicted(state.radius, age, jnp) * (1 + ROUND)
        added, known_age = self._noise(age)
        part = self.recursion.change * age * (before + self.recursion.error)
        after = (jnp.sqrt(before**2 + added) + part) * (1 + ROUND)
        radius = jnp.where(measured, after, before)
        # A prediction in one step over lost samples has longer Runge–Kutta steps than those of the proof.
        short = judged.repeated | (dt >= 0) & (dt <= self.recursion.ages[0, 1])
        aged = short & jnp.where(measured, known_age, age <= self.recursion.ages[-1, 1])
        position, velocity = jnp.split(radius * jnp.asarray(self.reach) * (1 + ROUND), 2)
        q, v = jnp.split(x, 2)
        conditions: tuple[tuple[Premise, Any], ...] = (
            (Premise.START, jnp.isfinite(state.radius)),
            (Premise.AGE, aged),
            # The recursion grows between samples at most to the larger of the distances before and after.
            (Premise.TUBE, (before <= self.radius) & (after <= self.radius) | ~measured & (before <= self.radius)),
            (Premise.VELOCITY, (jnp.abs(v) + velocity <= self.velocity).all()),
            (Premise.POSITION, self._inside(q, position).all()),
            (Premise.INPUT, ((self.inputs[0] <= u) & (u <= self.inputs[1])).all()),
            (Premise.STEP, judged.proved),
            (Premise.MEASUREMENT, judged.whole),
        )
        premise = jnp.zeros((), jnp.int32)
        for code, holds in reversed(conditions):
            premise = jnp.where(jnp.asarray(holds), premise, int(code))
        premise = jnp.where(state.premise > 0, state.premise.astype(jnp.int32), premise)
        known = premise == 0
        radius, position, velocity = (jnp.where(known, each, jnp.inf) for each in (radius, position, velocity))
        # After a measurement the radius is that of age 0; without one the last radius and its age go on.
        kept = jnp.where(measured, radius, jnp.where(known, state.radius, jnp.inf))
        new = BoundState(kept, jnp.where(measured, 0.0, age), premise.astype(kept.dtype))
        return new, BoundInfo(radius, position, velocity, premise)

    def _judged(self, y: Float[Array, "n"], dt: Scalar, result: Any) -> "_Judged":
        """What the observer's step did with a measurement, by its result code where that is given."""
        tiny, scalar = jnp.finfo(dt.dtype).tiny, len(self.circles) == 1
        # The same bounds as in `AbstractObserver.step`; false for NaN.
        admitted = jnp.abs(y) <= largest_measurement(y, [i for i, circle in enumerate(self.circles) if circle])
        every, none = admitted.all(), ~admitted.any()
        advanced, repeated = jnp.isfinite(dt) & (dt >= tiny), jnp.abs(dt) < tiny
        if result is None:
            used, unused, proved = every, none, jnp.ones((), bool)
        else:
            corrected, coasted, outlier, again = (jnp.asarray(result) == int(code) for code in _PROVED)
            refused = coasted | outlier
            # Of several positions a code does not tell which of them were used.
            used, unused, proved = every & corrected, refused & (none | scalar), corrected | refused | again & repeated
        return _Judged(advanced & used, repeated | ~advanced | used | unused, repeated, proved)

    def _noise(self, age: Scalar) -> tuple[Scalar, Array]:
        """G of a measurement of this age, and whether there is one."""
        ages = jnp.asarray(self.recursion.ages)
        fits = (ages[:, 0] <= age) & (age <= ages[:, 1])
        # Where an age follows from several numbers of lost samples, each of them is proved.
        return jnp.min(jnp.where(fits, jnp.asarray(self.recursion.noise), jnp.inf)), fits.any()

    def _inside(self, q: Vector, error: Vector) -> Array:
        """Whether positions with these errors are within the region (n,)."""
        low, high = self.positions
        circle = jnp.asarray(self.circles)
        middle = (low + high) / 2
        turned = jnp.where(circle, q - TURN * jnp.floor((q - middle) / TURN + 0.5), q)
        around = circle & (high - low >= TURN)
        return around | (low <= turned - error) & (turned + error <= high)


class _Judged(NamedTuple):
    """Whether a step used a whole measurement, used all or none of it, repeated a stamp, and is one of the proof."""

    used: Array
    whole: Array
    repeated: Array
    proved: Array


_PROVED = StepCode.OK, StepCode.COASTED, StepCode.OUTLIER, StepCode.REPEATED
"""Result codes of steps that are proved: a correction, two of a lost measurement, and one of a repeated stamp."""
