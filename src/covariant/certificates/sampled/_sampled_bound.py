"""Computes a proved bound of the estimation error after every sample, by the recursion of a certificate.

The certificate of a sampled observer shows how the distance between truth and estimate, in its metric, changes from
sample to sample (see `_radius_recursion`). `Bounded` runs this recursion as a part of the observer's step, with the
data of that step: the age of the measurement, the length and number of its Runge–Kutta steps, whether a correction was
made, and its result code. The radius after a sample bounds the error of each position and velocity. If a sample does
not confirm a premise of the certificate, the bounds become infinite and name that premise, until a restart.
"""

import enum
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Inexact

from covariant._typing import Code, Number, Scalar, Vector
from covariant.certificates.base import Recursion, is_same_observer
from covariant.models import MechanicalSystem
from covariant.observers import AbstractWrapper, Gated, Info, SampledState, without_last_input
from covariant.signals import StepCode
from scalargraph.errors import InputError

ROUND = 1e-9
"""Relative margin for the rounding of the recursion, which runs in doubles."""
ROUNDING = 1e-9
"""Least bound of a position [its unit], and of a velocity as a fraction of its largest value: the proof is about real
numbers, while rounding in doubles changes the estimate by some 1e-13."""
LARGE = 1e3
"""Position [1, or its unit] beyond which the least bounds grow in proportion to it, to thousands of roundings."""
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
    PREDICTION = 9
    CONTRADICTED = 10

    @property
    def message(self) -> str:
        """One line that describes the premise that may be violated."""
        return _MESSAGES[self]


_MESSAGES = {
    Premise.HOLDS: "the bound is proved",
    Premise.START: "no bound of the initial error was given, or it exceeds the radius of the certificate",
    Premise.AGE: "a step, or the time since the last measurement, is of a length for which nothing is proved",
    Premise.TUBE: "the error may be beyond the radius of the certificate",
    Premise.VELOCITY: "the velocity may be beyond the bound of the certificate",
    Premise.POSITION: "the position may be outside of the region of the certificate",
    Premise.MEASUREMENT: "only some positions were measured or used, for which nothing is proved",
    Premise.INPUT: "the input is outside of the bounds of the certificate",
    Premise.STEP: "the certificate does not cover what the observer's step did, such as a restart: see its result code",
    Premise.PREDICTION: (
        "the errors of the prediction's Runge–Kutta steps are not proved for steps of this length; certify an observer "
        "with a fixed number of substeps"
    ),
    Premise.CONTRADICTED: (
        "the measurement is farther from the prediction than the bound and the measurement error together allow, so "
        "that the truth breaks an assumption of the certificate"
    ),
}


class BoundedState(NamedTuple):
    """State of a `Bounded` observer.

    Attributes:
        inner: state of the observer.
        radius: proved distance right after the last measurement, in the metric; infinite if nothing is known.
        premise: `Premise` as a number: 0, or the first one that failed.
        last_input: the last finite input (m,).

    Example:
        >>> from covariant.certificates.sampled import BoundedState
        >>> BoundedState._fields
        ('inner', 'radius', 'premise', 'last_input')
    """

    inner: Any
    radius: Scalar
    premise: Scalar
    last_input: Float[Array, "m"] | None = None


class BoundedInfo(NamedTuple):
    """Diagnostics of a step of a `Bounded` observer.

    Attributes:
        innovation: difference (n,) from the predicted to the measured configuration, as in `observers.Info`.
        distance: its length in the metric of the model.
        radius: proved distance between truth and estimate, in the metric of the present age.
        position_bound: bound (n,) of the error of each position [unit].
        velocity_bound: bound (n,) of the error of each velocity [unit/s].
        premise: `Premise` as an integer; the bounds are infinite unless it is 0.
        result: a `covariant.signals.StepCode` code.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates import Premise
        >>> from covariant.certificates.sampled import BoundedInfo
        >>> none, unknown = jnp.zeros(1), jnp.array([jnp.inf])
        >>> info = BoundedInfo(none, none[0], unknown[0], unknown, unknown, jnp.array(2), jnp.array(0))
        >>> Premise(int(info.premise)).name
        'AGE'
    """

    innovation: Vector
    distance: Scalar
    radius: Scalar
    position_bound: Vector
    velocity_bound: Vector
    premise: Code
    result: Code


class SampledBound(eqx.Module):
    """The observer and the numbers of a certificate from which `Bounded` computes its bound.

    Attributes:
        certified: the observer of the bound.
        recursion: constants of the recursion.
        radius: ε of the certificate.
        reach: bounds (2n,) of each position and velocity error at a distance of 1.
        start: weights (2n,) of the squared initial errors in the squared distance; ∞ if the certificate has none.
        positions: least and largest true positions (2, n), on rotations of the matrix entries.
        velocity: bounds (n,) of the true velocities.
        inputs: least and largest inputs (2, m).
        noise: bounds (n,) of the errors of the measured positions.
        substeps: number of Runge–Kutta steps of a prediction.
        longest_step: longest Runge–Kutta step [s] with a proved error; 0 if there is none.
        missing_rows: whether one prediction may cover lost samples.
        circles: for each position (n,) whether it is an angle on a circle; None on rotations.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> from covariant.certificates.sampled import SampledBound
        >>> from covariant.certificates.base._radius_recursion import Recursion
        >>> observer = observers.Intrinsic(models.oscillator(), 10.0, 40.0, substeps=1)
        >>> recursion = Recursion(2.0, 0.0, (1e-6,), 0.0, 0.0, 0.0, np.array([[0.01, 0.02]]))
        >>> about = observer, recursion
        >>> region = np.array([[-3.0], [3.0]]), np.array([4.0]), np.array([[-1.0], [1.0]]), np.zeros(1)
        >>> bound = SampledBound(
        ...     *about, 0.1, np.array([1.0, 10.0]), np.array([2.0, 0.02]), *region, 1, 0.01, False, (False,)
        ... )
        >>> round(bound.within(0.01, 0.1), 4), bound.within(0.1, 0.1)
        (0.02, inf)
    """

    certified: Any
    recursion: Recursion
    radius: float
    reach: Float[np.ndarray, "two_n"]
    start: Float[np.ndarray, "two_n"]
    positions: Float[np.ndarray, "2 k"]
    velocity: Float[np.ndarray, "n"]
    inputs: Float[np.ndarray, "2 m"]
    noise: Float[np.ndarray, "n"]
    substeps: int | None = eqx.field(static=True)
    longest_step: float
    missing_rows: bool = eqx.field(static=True)
    circles: tuple[bool, ...] | None = eqx.field(static=True)

    def within(self, position: Any, velocity: Any) -> float:
        """Bound the distance, given bounds of the initial errors; infinite if it may exceed the radius."""
        try:
            shape = self.velocity.shape
            errors = np.concatenate([np.broadcast_to(np.asarray(b, float), shape) for b in (position, velocity)])
            valid = (errors >= 0).all()
        except (TypeError, ValueError):  # no numbers, or more than there are positions
            errors, valid = np.zeros(0), False
        if not valid:
            n = len(self.velocity)
            raise InputError(
                f"bounded: bounds of initial errors must be numbers ≥ 0, one or {n} of positions and of velocities; "
                f"got {position} and {velocity}"
            )
        weighted = np.where(errors > 0, self.start, 0.0) * errors**2
        return self.known(float(np.sqrt(weighted.sum())) * (1 + ROUND))

    def known(self, radius: float) -> float:
        """Return the radius, or ∞ if it exceeds the radius of the certificate."""
        return radius if radius <= self.radius else np.inf

    def step(
        self,
        state: BoundedState,
        before: SampledState,
        after: SampledState,
        info: Info,
        u: Float[Array, "m"],
        y: Inexact[Array, "*n"],
        dt: Scalar,
        missing: Array,
    ) -> tuple[Scalar, Scalar, BoundedInfo]:
        """Advance the bound over a step of the observer.

        Args:
            state: the state before the step.
            before: the certified observer's state before the step.
            after: its state after the step.
            info: the info of the step.
            u: the input (m,) that it used.
            y: the measurement, NaN if it counts as missing.
            dt: the length of its prediction [s], 0 if it made none.
            missing: which entries of y are missing.

        Returns:
            Radius and premise to store, and the diagnostics.
        """
        corrected, coasted, outlier, repeated = (info.result == int(code) for code in _COVERED)
        # The age that the gains of this step used, and whether the step used a measurement of this age.
        assert before.age is not None
        age = before.age + dt
        used = (dt > 0) & (after.age == 0)
        whole = jnp.where(used, corrected & ~missing.any(), (after.age == age) | repeated)
        before_radius = self.recursion.predicted(state.radius, age, jnp) * (1 + ROUND)
        added, known_age = self._noise(age)
        # The term hD(a + β) of the recursion.
        factor_term = self.recursion.change * age * (before_radius + self.recursion.error)
        after_radius = (jnp.sqrt(before_radius**2 + added) + factor_term) * (1 + ROUND)
        radius = jnp.where(used, after_radius, before_radius)
        position, velocity = self._errors(radius, after.q)
        # Lost samples may be rows without a measurement, or with `missing_rows` no rows at all.
        longest = self.recursion.ages[-1 if self.missing_rows else 0, 1]
        aged = (dt <= longest) & jnp.where(used, known_age, age <= self.recursion.ages[-1, 1])
        allowed_noise = self.noise * (1 + ROUND)
        proved_step = dt <= self.longest_step * (self.substeps or 0)
        conditions: tuple[tuple[Premise, Any], ...] = (
            (Premise.START, jnp.isfinite(state.radius)),
            (Premise.AGE, aged),
            (Premise.PREDICTION, proved_step),
            # Between samples the bound is at most the larger one of the bounds before and after the measurement.
            (Premise.TUBE, (before_radius <= self.radius) & (~used | (after_radius <= self.radius))),
            (Premise.VELOCITY, (jnp.abs(after.v) + velocity <= self.velocity).all()),
            (Premise.POSITION, self._inside(after.q, position).all()),
            (Premise.INPUT, ((self.inputs[0] <= u) & (u <= self.inputs[1])).all()),
            (Premise.STEP, corrected | coasted | outlier | repeated & (dt == 0)),
            (Premise.MEASUREMENT, whole),
            (
                Premise.CONTRADICTED,
                ~used | (jnp.abs(info.innovation) <= self._errors(before_radius, after.q)[0] + allowed_noise).all(),
            ),
        )
        premise = jnp.zeros((), jnp.int32)
        for code, holds in reversed(conditions):
            premise = jnp.where(jnp.asarray(holds), premise, int(code))
        premise = jnp.where(state.premise > 0, state.premise.astype(jnp.int32), premise)
        known = premise == 0
        radius, position, velocity = (jnp.where(known, each, jnp.inf) for each in (radius, position, velocity))
        # A measurement stores the new radius with age 0; without one, the last radius stays and its age grows.
        stored = jnp.where(used, radius, jnp.where(known, state.radius, jnp.inf))
        told = BoundedInfo(info.innovation, info.distance, radius, position, velocity, premise, info.result)
        return stored, premise.astype(stored.dtype), told

    def _errors(self, radius: Scalar, q: Array) -> tuple[Vector, Vector]:
        """Compute bounds (n,) of the errors of positions and velocities at a distance."""
        position, velocity = jnp.split(radius * jnp.asarray(self.reach) * (1 + ROUND), 2)
        # Large positions, such as angles of many turns, have larger rounding errors.
        rounding = ROUNDING * (1 + jnp.max(jnp.abs(q)) / LARGE)
        of_position, of_velocity = np.split(self.reach, 2)
        return position + rounding, velocity + rounding * (self.velocity + np.max(of_velocity) / np.min(of_position))

    def _noise(self, age: Scalar) -> tuple[Scalar, Array]:
        """Look up the noise term G for a measurement of this age, and whether the certificate covers the age."""
        ages = jnp.asarray(self.recursion.ages)
        fits = (ages[:, 0] <= age) & (age <= ages[:, 1])
        # If several numbers of lost samples allow this age, all are proved, so the least G holds.
        return jnp.min(jnp.where(fits, jnp.asarray(self.recursion.noise), jnp.inf)), fits.any()

    def _inside(self, q: Array, error: Vector) -> Array:
        """Test for each entry whether all positions within these errors are inside the region."""
        low, high = self.positions
        if self.circles is None:
            # Entries of a rotation are at most 1 in size, and change by no more than the angle.
            angle, entries = jnp.linalg.norm(error), q.ravel()
            return ((low <= -1) | (low <= entries - angle)) & ((high >= 1) | (entries + angle <= high))
        circle = jnp.asarray(self.circles)
        middle = (low + high) / 2
        wrapped = jnp.where(circle, q - TURN * jnp.floor((q - middle) / TURN + 0.5), q)
        full_circle = circle & (high - low >= TURN)
        return full_circle | (low <= wrapped - error) & (wrapped + error <= high)


_COVERED = StepCode.OK, StepCode.COASTED, StepCode.OUTLIER, StepCode.REPEATED
"""Result codes of steps that the proof covers: a correction, two codes of a lost measurement, and a repeated stamp."""


class Bounded(AbstractWrapper):
    """A certified observer whose step also returns a proved bound of its error; from `certificate.bounded()`.

    The estimate is that of the observer itself. The bound rests on the assumptions of the certificate, above all that
    noise and unknown force are within the stated bounds, and that stamps are exact. Each step checks what it can: the
    age of the measurement; the lengths of its Runge–Kutta steps; the input; the distance between measurement and
    prediction, which the bound limits; and that all states within the bound are in the region of positions and
    velocities. Between samples this last condition is assumed. A measurement that was not used, since it is missing,
    too large or refused by the gate, corrects nothing: it counts as a lost sample.

    Use it to know at every sample how far the estimate may be off, for a safety monitor rather than for a design. As a
    worst case, the bound exceeds the usual error many times; for standard deviations use a filter.

    Attributes:
        observer: the certified observer, or that observer behind a gate, in doubles.
        bound: the observer and the numbers of the certificate.
        first_radius: bound of the distance between truth and estimate after `init`; ∞ if it is unknown.

    Raises:
        ValueError: `observer` does not take the steps of `bound.certified`, or `first_radius` is negative. `init` and
            `step` raise it for numbers that are not doubles.

    Example:
        An oscillator whose speed is at most 0.4 m/s when the observer starts from rest:

        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.certificates import Premise, certify
        >>> from covariant.observers import Intrinsic
        >>> observer = Intrinsic(models.oscillator(), 10.0, 40.0, substeps=1)
        >>> box = {"position": (-2.0, 2.0), "velocity": 3.0, "error": 0.3}
        >>> certificate = certify(observer, **box, interval=(0.01, 0.01), lost=1, checker="off")
        >>> bounded = certificate.bounded(position=0.0, velocity=0.4)
        >>> state = bounded.init(jnp.array([0.5]))
        >>> state, info = bounded.step(state, jnp.zeros(1), jnp.array([0.5]), 0.01)
        >>> Premise(int(info.premise)).name, bool(info.velocity_bound[0] < 1.0)
        ('HOLDS', True)
        >>> bounded.step(state, jnp.zeros(1), jnp.array([0.5]), 0.5)[1].velocity_bound.tolist()  # too late
        [inf]
    """

    observer: Any
    bound: SampledBound
    first_radius: float = np.inf

    def __check_init__(self):
        if not runs(self.observer, self.bound.certified):
            raise InputError(
                "bounded: the observer is not the one of the certificate, nor that one behind a gate without a fast "
                "start; certify it"
            )
        if not isinstance(self.first_radius, Tracer) and not np.all(np.asarray(self.first_radius) >= 0):
            raise InputError(f"bounded: the first radius must be a number ≥ 0; got {self.first_radius}")

    fixed_numbers = True

    @property
    def model(self) -> MechanicalSystem:
        """The mechanical system of the observer."""
        return self.observer.model

    def init(self, y: Array, t: Number = 0.0) -> BoundedState:
        first = self.observer.init(y, t)
        inner, last_input = without_last_input(first), first.last_input
        radius = jnp.asarray(self.first_radius, float)
        state = BoundedState(inner, radius, jnp.where(jnp.isfinite(radius), 0.0, float(Premise.START)), last_input)
        _need_doubles(state)
        return state

    def predict(self, state: BoundedState, u: Float[Array, "m"], dt: Scalar) -> BoundedState:
        _need_doubles(state)
        return self._unknown(state, self.observer.predict(state.inner, u, dt))

    def correct(self, state: BoundedState, u: Float[Array, "m"], y: Array) -> tuple[BoundedState, BoundedInfo]:
        """Correct a predicted state; the bound is then unknown, since only `step` sees both states of a step."""
        inner, info = self.observer.correct(state.inner, u, y)
        unknown = jnp.full(info.innovation.shape, jnp.inf)
        told = info.innovation, info.distance, unknown[0], unknown, unknown, jnp.asarray(int(Premise.STEP)), info.result
        return self._unknown(state, inner), BoundedInfo(*told)

    def reported(
        self, before: BoundedState, after: BoundedState, info: Any, u: Float[Array, "m"], y: Array, dt: Scalar
    ) -> tuple[BoundedState, BoundedInfo]:
        _need_doubles(before)
        _need_double(jnp.asarray(y))
        states = certified_state(before.inner), certified_state(after.inner)
        missing = self.model.manifold.missing(y)
        radius, premise, told = self.bound.step(before, *states, info, u, y, dt, missing)
        return after._replace(radius=radius, premise=premise), told

    @staticmethod
    def _unknown(state: BoundedState, inner: Any) -> BoundedState:
        """Replace the inner state by one without a known bound."""
        unknown = jnp.full_like(state.radius, jnp.inf), jnp.full_like(state.premise, float(Premise.STEP))
        return state._replace(inner=inner, radius=unknown[0], premise=unknown[1])

    def innovation(self, state: BoundedState, u: Float[Array, "m"], y: Array) -> Vector:
        return self.observer.innovation(state.inner, u, y)

    def estimate(self, state: BoundedState) -> Any:
        return self.observer.estimate(state.inner)


def _need_doubles(state: BoundedState) -> None:
    for number in (certified_state(state.inner).q, state.radius):
        _need_double(number)


def _need_double(number: Array) -> None:
    if number.dtype != np.float64:
        raise InputError(
            f"Bounded: the proof is about doubles, and here is a {number.dtype}; give the measurement as float64, "
            "with jax_enable_x64 on"
        )


def without_gate(observer: Any) -> Any:
    """The observer behind a gate, or the observer itself."""
    # A subclass may do more than refusing measurements.
    return observer.observer if type(observer) is Gated else observer


def runs(observer: Any, certified: Any) -> bool:
    """Whether an observer takes the steps of a certified one, possibly behind a gate, from its start on."""
    inner = without_gate(observer)
    if inner is not observer and observer.fast_start:
        return False
    if inner is certified:
        return True
    inside = (any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(each)) for each in (inner, certified))
    match tuple(inside):
        case (True, True):  # the values are not known, inside of a compiled function that got both
            return type(inner) is type(certified)
        case (False, False):
            return is_same_observer(inner, certified)
    return False


def certified_state(state: Any) -> SampledState:
    """Extract the state of the certified observer from the state of an observer that may have a gate."""
    return state if "q" in state._fields else certified_state(state.inner)
