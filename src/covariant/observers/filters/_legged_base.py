"""Estimates the velocity of a legged robot's base, by integrating an IMU and using standing feet as fixed points.

The IMU is the input of the prediction. The encoders measure the position of each foot in the axes of the base. As long
as a foot stands, it is at its anchor, a fixed point that the filter tracks. In these axes the model is linear except
for the gyro bias, so a wrong initial attitude does no harm; position and heading, which are not measured, are not
states.

The filter does not know the magnitude of gravity, which would make it nonlinear: a gravity that was known along a
wrongly estimated vertical would remain wrong with a small variance. The magnitude is a constant of the motion, so it
may be used last: each estimate is the state of the linear filter given the magnitude, and the filter goes on without.

The gate is decisive: a foot that is not at its anchor is refused, and *anchored anew at once* at its measured position.
So feet in the air need no flags. A gate that refuses and waits would refuse for ever. It refuses only readings that a
standing foot practically never gives, as refusing true ones makes the covariance too small: those that pass are then
smaller than the filter expects. So it has to detect slow feet otherwise. A foot that leaves the ground deviates in one
direction, while the innovations of a standing foot are independent, so their average is judged as well. A foot that
was anchored anew has to stay at its first place for a while before it corrects anything; displacements add up and
noise does not.

Source: Bloesch et al. 2012, State estimation for legged robots, RSS; Hartley, Ghaffari, Eustice & Grizzle 2020,
Contact-aided invariant extended Kalman filtering for robot state estimation, IJRR 39(4).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._linalg import half_solve, solve
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.geometry.lie import SO3
from covariant.models import ON_THE_GROUND, StateSpace
from covariant.observers.base import AbstractObserver, LastInput, check_finite, check_positive, no_input, with_block
from covariant.observers.filters._state_noise import StateNoise
from covariant.signals import AnyArray, StepCode

THRESHOLD = 18.0
"""Squared distance of a foot from its anchor, by its covariance, above which it is anchored anew: χ² at 0.05 %."""
AVERAGED = 4.0
"""Number of innovations over which their average is taken."""
PROBATION = 0.02
"""Time [s] for which a foot that was anchored anew has to stand before it corrects the estimate."""
LINEARISATIONS = 4
"""Number of times that the magnitude of gravity is linearised at the estimate that the previous time gave."""
PATIENCE = 0.5
"""Time [s] without any correction by a foot after which the estimate restarts; it is longer than a jump."""


class LeggedBaseState(NamedTuple):
    """State of a `LeggedBase`.

    Attributes:
        x: Velocity of the base, gravity, anchors of the feet, biases of gyro and accelerometer (n,), in its axes, from
            a filter that does not know the magnitude of gravity; `LeggedBase.estimate` uses it.
        t: Time [s].
        cov: Covariance (n, n).
        turned: Rotation (F, 3, 3) of each foot's link in the axes of the base at its last reading.
        alone: Time [s] since a foot last corrected the estimate.
        average: Average innovation (F, 3) of each foot, scaled such that it has unit covariance while the foot stands.
        stood: Time (F,) [s] since each foot was anchored.
        last_input: Last finite reading (6,) of the IMU.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.observers.filters import LeggedBaseState
        >>> zero, turned = jnp.zeros(()), jnp.eye(3)[None]
        >>> state = LeggedBaseState(jnp.zeros(15), zero, jnp.eye(15), turned, zero, jnp.zeros((1, 3)), jnp.zeros(1))
        >>> state.turned.shape, state.last_input is None
        ((1, 3, 3), True)
    """

    x: Vector
    t: Scalar
    cov: Matrix
    turned: Float[Array, "F 3 3"]
    alone: Scalar
    average: Float[Array, "F 3"]
    stood: Float[Array, "F"]
    last_input: LastInput = None


class LeggedBaseInfo(NamedTuple):
    """Diagnostics of a step of a `LeggedBase`.

    Attributes:
        innovation: Smallest change (p,) of the joints that puts each foot at its anchor [rad or m]; 0 for feet that
            are not standing, and for flags.
        distance: Square root of the sum of `squares`.
        squares: Squared distance (F,) of each standing foot from its anchor, by its covariance; 0 for others.
        state_std: Standard deviations (n,) of the states.
        standing: Which feet (F,) were at their anchors, for long enough to correct the estimate.
        result: A `covariant.signals.StepCode` code.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.observers.filters import LeggedBaseInfo
        >>> down, ok = jnp.array([True, False]), jnp.zeros((), int)
        >>> info = LeggedBaseInfo(jnp.zeros(6), jnp.zeros(()), jnp.zeros(2), jnp.ones(18), down, ok)
        >>> int(info.standing.sum())
        1
    """

    innovation: Vector
    distance: Scalar
    squares: Float[Array, "F"]
    state_std: Vector
    standing: Bool[Array, "F"]
    result: Code


class LeggedBase(AbstractObserver):
    """Velocity and attitude of the base of a robot on legs, from an IMU and the encoders of its legs.

    It needs no contact flags, masses or torques: with a usable accelerometer, the dynamics add no information. If a log
    has flags, 0 prevents a foot from being an anchor. A measurement consists of the positions of the joints, followed
    by flags if the model has them. If encoder readings are late relative to the IMU, wrap it in a `Delayed`.

    Attributes:
        model: State-space model of the base, from the system `legged_base`.
        process_cov: Spectral density (n, n), diagonal: noise of the accelerometer [(m/s²)²/Hz], noise of the gyro times
            gravity squared, creep of the feet [m²/s], drift of the biases.
        measurement_cov: Covariance (p, p) of a reading of the joints [rad² or m²].
        start: First estimate (n,); its anchors are not used.
        start_cov: Its covariance (n, n).
        threshold: Squared distance of a foot from its anchor, by its covariance, above which it is anchored anew.

    Raises:
        ValueError: A covariance or the start is not finite, or the threshold is not positive.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> feet = {f"{leg}_FOOT": [0.0, 0.0, 0.0] for leg in ("FL", "FR", "HL", "HR")}
        >>> model = models.load("legged_base", {"parameters.path": "quadruped", "parameters.feet": feet}).model
        >>> start = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -9.81, *18 * [0.0]])
        >>> base = observers.LeggedBase(model, 1e-6 * np.eye(24), 1e-7 * np.eye(12), start, np.eye(24))
        >>> state = base.init(np.zeros(12))
        >>> base.estimate(state)[6:9].round(3).tolist()  # the anchor of a stretched leg
        [0.195, 0.147, -0.32]
    """

    model: StateSpace
    process_cov: Matrix
    measurement_cov: Float[Array, "p p"]
    start: Vector
    start_cov: Matrix
    threshold: float | Scalar = THRESHOLD

    def __check_init__(self):
        check_finite(
            "LeggedBase",
            process_cov=self.process_cov,
            measurement_cov=self.measurement_cov,
            start=self.start,
            start_cov=self.start_cov,
        )
        check_positive("LeggedBase", threshold=self.threshold)

    @property
    def _legs(self) -> Any:
        return self.model.f

    @property
    def _joints(self) -> int:
        """Number of joints."""
        return self._legs.joints

    def configuration(self, y: AnyArray) -> Any:
        return y[: self._joints]

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> LeggedBaseState:
        """State at the first positions of the joints, with an anchor at each foot.

        Args:
            y: Positions of all joints, and flags if the model has them.
            t: Time [s].

        Returns:
            The state.
        """
        places, turned, noise, _ = self._read(y)
        x, cov, average, stood = self._start(places, noise)
        t = jnp.asarray(t, y.dtype)
        return LeggedBaseState(x, t, cov, turned, jnp.zeros_like(t), average, stood, no_input(self.model, x))

    def _start(self, places: Array, noise: Array) -> tuple[Vector, Matrix, Array, Vector]:
        """First estimate and its covariance with an anchor at each foot, whose innovations were 0 and which stands."""
        x, cov = jnp.asarray(self.start, places.dtype), jnp.asarray(self.start_cov, places.dtype)
        blocks = jnp.zeros_like(cov)
        for i in range(len(places)):
            at = slice(6 + 3 * i, 9 + 3 * i)
            x, blocks = x.at[at].set(places[i]), blocks.at[at, at].set(noise[i])
        anchors = jnp.asarray(np.repeat([False, True, False], [6, len(x) - 12, 6]))
        return x, with_block(cov, blocks, anchors), jnp.zeros_like(places), jnp.full(len(places), PROBATION, x.dtype)

    def estimate(self, state: LeggedBaseState) -> Vector:
        return self._on_sphere(state.x, state.cov)[0]

    def predict(self, state: LeggedBaseState, u: Float[Array, "6"], dt: Scalar) -> LeggedBaseState:
        """Integrate the IMU over dt.

        Args:
            state: State after the previous sample.
            u: Angular velocity (3,) [rad/s] and specific force (3,) [m/s²], constant over dt.
            dt: Length of the prediction [s].

        Returns:
            The predicted state.
        """
        real = state.x.dtype

        def ahead(x, u):
            new = self._legs.step(x, u, dt)
            return new, new

        # The products with the gyro bias are linearised at the estimate that uses the magnitude of gravity.
        at = self.estimate(state)
        (by_state, by_input), x = jax.jacfwd(ahead, (0, 1), has_aux=True)(at, u)
        x = x + by_state @ (state.x - at)
        density = jnp.diag(jnp.asarray(self.process_cov, real))
        gravity = jnp.asarray(self.start, real)[3:6]
        # Accelerometer noise enters the velocity, gyro noise all vectors that turn with the base. The mean of noise
        # over dt has the variance of its density divided by dt.
        imu = jnp.concatenate([density[3:6] / (gravity @ gravity), density[:3]])
        pushed = by_input * jnp.sqrt(imu)[None]
        spacing = jnp.where(dt > 0, dt, 1.0)
        added = jnp.diag(jnp.where(jnp.arange(len(x)) < 6, 0.0, density) * dt)
        cov = _symmetric(by_state @ (state.cov @ by_state.T) + pushed @ pushed.T / spacing + added)
        return state._replace(x=x, t=state.t + dt, cov=cov, alone=state.alone + dt, stood=state.stood + dt)

    def correct(
        self, state: LeggedBaseState, u: Float[Array, "6"], y: Float[Array, "p"]
    ) -> tuple[LeggedBaseState, LeggedBaseInfo]:
        """Compare each foot with its anchor, one after the other; a foot that is off is anchored anew.

        Args:
            state: State that `predict` returned.
            u: Readings of the IMU over the prediction.
            y: Positions of the joints, NaN where missing, and flags, NaN where unknown.

        Returns:
            The corrected state and the info.
        """
        joints, real = self._joints, y.dtype
        places, turned, noise, slopes = self._read(y)
        read = jnp.stack([~jnp.any(jnp.isnan(y[jnp.asarray(carrying)])) for carrying in self._legs.carrying])
        feet = len(places)
        down = ~(y[joints:] < ON_THE_GROUND) if len(y) > joints else jnp.ones(feet, bool)
        turned = jnp.where(read[:, None, None], turned, state.turned)
        # The centre of a rolling foot moves by the rotation of its link relative to the base; the rotation of the base
        # itself is part of the prediction.
        x = state.x
        moved = _turns(turned, state.turned)
        rolled = jnp.cross(moved, self._legs.up(self.estimate(state)[3:6])[None])
        x = x.at[6:-6].add(rolled.ravel())

        # The foot that is nearest to its anchor comes first, as a foot that is wrongly taken for standing would make
        # those that stand appear to move.
        def against_anchor(x: Vector, cov: Matrix, i: Any) -> tuple[Array, Array, Array]:
            rows = cov[6:-6].reshape(feet, 3, len(x))[i]
            return rows, rows[:, 6:-6].reshape(3, feet, 3)[:, i] + noise[i], places[i] - x[6:-6].reshape(feet, 3)[i]

        pairs = (against_anchor(x, state.cov, i)[1:] for i in range(feet))
        far = jnp.stack([off @ solve(spread, off) for spread, off in pairs])

        repeated = jnp.asarray(np.tile(np.eye(3), (feet + 4, 1)), real)

        def foot(carry: tuple[Array, ...], _: None) -> Any:
            x, cov, far, *memory = carry
            i = jnp.argmin(far)
            rows, spread, innovation = against_anchor(x, cov, i)
            scaled = half_solve(spread, innovation[:, None])[:, 0]
            square = scaled @ scaled
            average = state.average[i] + (scaled - state.average[i]) / AVERAGED
            # The average of independent numbers of unit variance has the variance 1 / (2 AVERAGED − 1).
            largest = jnp.maximum(square, (2 * AVERAGED - 1) * (average @ average))
            stands = read[i] & down[i] & (largest < jnp.asarray(self.threshold, real))
            trusted, anew = stands & (state.stood[i] >= PROBATION), read[i] & ~stands
            gain = solve(spread, rows).T
            # Joseph's form, (1 − KH) P (1 − KH)ᵀ + K N Kᵀ, where H selects the three entries of the anchor.
            once = cov - gain @ rows
            used_cov = once - (once[:, 6:-6].reshape(len(x), feet, 3)[:, i] - gain @ noise[i]) @ gain.T
            own = jnp.repeat(jnp.arange(-2, feet + 2) == i, 3)
            x = jnp.where(trusted, x + gain @ innovation, jnp.where(anew & own, repeated @ places[i], x))
            renewed = with_block(cov, repeated @ noise[i] @ repeated.T, own)
            cov = jnp.where(trusted, used_cov, jnp.where(anew, renewed, cov))
            ours = (
                jnp.where(trusted, innovation, 0.0),
                jnp.where(trusted, square, 0.0),
                trusted,
                jnp.where(trusted, average, jnp.where(read[i], 0.0, state.average[i])),
                jnp.where(anew, 0.0, state.stood[i]),
            )
            memory = (old.at[i].set(new) for old, new in zip(memory, ours, strict=True))
            return (x, cov, far.at[i].set(jnp.inf), *memory), None

        carry = x, state.cov, far, jnp.zeros_like(places), far, read, state.average, state.stood
        (x, cov, _, off, squares, standing, average, stood), _ = jax.lax.scan(foot, carry, length=feet)
        alone = jnp.where(jnp.any(standing), 0.0, state.alone)
        lost = (alone > PATIENCE) & jnp.all(read)
        known = x, cov, average, stood, alone
        fresh = *self._start(places, noise), jnp.zeros_like(alone)
        x, cov, average, stood, alone = jax.tree.map(lambda new, old: jnp.where(lost, new, old), fresh, known)
        new = state._replace(x=x, cov=_symmetric(cov), turned=turned, alone=alone, average=average, stood=stood)
        result = jnp.where(jnp.any(read), int(StepCode.OK), int(StepCode.COASTED))
        result = jnp.where(lost, int(StepCode.RESTARTED), result)
        finite = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(cov))
        result = jnp.where(finite, result, int(StepCode.NOT_FINITE)).astype(jnp.int32)
        # The smallest change of a foot's joints that moves it by `off`.
        each = jnp.stack([slopes[i].T @ solve(_regular(slopes[i]), off[i]) for i in range(feet)])
        innovation = jnp.concatenate([jnp.sum(each, axis=0), jnp.zeros(len(y) - joints, real)])
        std = jnp.sqrt(jnp.maximum(jnp.diag(self._on_sphere(x, new.cov)[1]), 0.0))
        return new, LeggedBaseInfo(innovation, jnp.sqrt(jnp.sum(squares)), squares, std, standing, result)

    def _read(self, y: Float[Array, "p"]) -> tuple[Array, Array, Array, Array]:
        """Positions and rotations of the feet, the covariance of the positions, and their derivatives by the joints."""
        joints = self._joints
        q = jnp.where(jnp.isnan(y[:joints]), 0.0, y[:joints])

        places, turned, slopes = self._legs.feet(q)
        noise = jnp.asarray(self.measurement_cov, y.dtype)[:joints, :joints]
        least = 1e-10 * jnp.eye(3, dtype=y.dtype)[None]  # straight legs show one direction poorly; it stays regular
        return places, turned, slopes @ noise @ jnp.swapaxes(slopes, 1, 2) + least, slopes

    def _on_sphere(self, x: Vector, cov: Matrix) -> tuple[Vector, Matrix]:
        """Mean and covariance given that gravity has its initial magnitude, linearised where the mean comes to lie."""
        start = jnp.asarray(self.start, x.dtype)[3:6]
        square, gravity = start @ start, x[3:6]
        given, gain, along = x, x, x
        for _ in range(LINEARISATIONS):
            down = gravity / jnp.sqrt(gravity @ gravity)
            along = cov[:, 3:6] @ down
            # The magnitude is known to the precision of its number, which keeps a divisor from zero.
            gain = along / (down @ along[3:6] + jnp.finfo(x.dtype).eps * square)
            given = x + gain * (jnp.sqrt(square) - down @ x[3:6])
            gravity = given[3:6]
        return given, cov - jnp.outer(gain, along)


def _symmetric(cov: Matrix) -> Matrix:
    """A symmetric matrix without rounding errors, which halves the work when it is lowered."""
    return jnp.where(np.tri(len(cov), dtype=bool).T, cov, cov.T)


def _regular(slope: Float[Array, "3 p"]) -> Float[Array, "3 3"]:
    """Product of a slope with its transpose, made regular for a straight leg."""
    return slope @ slope.T + 1e-6 * jnp.eye(3, dtype=slope.dtype)


def _turns(new: Float[Array, "F 3 3"], old: Float[Array, "F 3 3"]) -> Float[Array, "F 3"]:
    """Small rotation vectors, in the axes of the base, from old rotations to new ones."""
    change = jnp.sum(new[:, :, None, :] * old[:, None, :, :], axis=3)
    return jax.vmap(SO3.vee)(change)


def legged_base(model: StateSpace, noise: StateNoise) -> LeggedBase:
    """Observer for the base of a legged robot."""
    return LeggedBase(model, noise.process_cov, noise.measurement_cov, noise.start, noise.start_cov)
