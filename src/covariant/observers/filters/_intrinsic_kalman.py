"""Defines the intrinsic Kalman filter (error and covariance in the parallel frame), the same in all coordinates.

For a true motion (q, v) the error at the estimate is `ε = log_q̂ q` and `ν = Tv − v̂`, with T the parallel transport
along the geodesic from q to q̂. The covariance P of (ε, ν) is a tensor at q̂. Two maps change it: the flow of the model,
and the change of base point by a correction. Both are differentiated automatically, and these derivatives contain the
curvature, the change of the force and the friction, so none of them needs a formula here. The only other relation that
the two maps need is `ν = δv + B(ε, v)`, for components δv in a frame that is not parallel.

Source: Ge, van Goor & Mahony 2025, on the reset; Kailath, Sayed & Hassibi 2000, Linear Estimation, chapter 12, for the
array form; Bar-Shalom, Li & Kirubarajan 2001, section 5.4, for the gate.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Inexact

from covariant._linalg import semidefinite_root, triangular
from covariant._typing import Code, Matrix, Number, Scalar, Vector
from covariant.geometry import AbstractManifold, Budget
from covariant.models import MechanicalSystem
from covariant.observers.base import (
    Covariance,
    Encoded,
    Gate,
    GateMemory,
    Judged,
    LastInput,
    Readings,
    Velocity,
    as_gain,
    at_rest,
    check_covariance,
    check_positive,
    covariance_along,
    covariance_at,
    diagonal,
    needed_substeps,
    normalised_square,
    take,
    updated,
    white_acceleration,
    with_block,
)
from covariant.observers.filters._flow import apart, flow_with_slope, inverse, parallel, with_part_across
from covariant.observers.filters._gated_filter import AbstractMechanicalFilter, Expectation, Moved, Used
from covariant.observers.filters._noise_scale import NoiseScale, factor_of, scaled
from covariant.observers.sensors import (
    InputStates,
    MissingInputs,
    Sensed,
    Sensor,
    SensorInfo,
    Sensors,
    SlowStates,
    SlowVariables,
    SlowVector,
    as_groups,
    missing_now,
)
from covariant.signals import AnyArray, StepCode
from scalargraph.errors import InputError

# Three such deviations are about a quarter turn, where sin has its maximum and a linearisation fails.
FARTHEST_TURN = 0.5
"""Standard deviation of an angle [rad] beyond which the estimate restarts, as after a long gap in the log."""


class KalmanState(NamedTuple):
    """State of an `IntrinsicKalman`: the estimate, a square root of its covariance, and the memory of the gate.

    Attributes:
        q: Estimated configuration q̂: coordinates (n,), or a group element (N, N).
        v: Estimated velocity v̂ (n,) in the frame of the space.
        t: Time [s] of the estimate.
        slow: Estimated slow states (k,), before `SlowVariables.values` is applied.
        root: Square root S (2n + k, 2n + k) of the covariance `S Sᵀ` of (ε, ν) in the parallel frame, followed by the
            slow states.
        gate: Memory of the gate.
        last_input: Last finite input (m,), which replaces an input that is not finite; None if none is stored.
        readings: Last readings of encoders that count ticks; None if measurements have noise.
        sensor_gates: Memories of the gates of further sensors, one each.
        missing_input: Which inputs (m,) were missing over the last step; None if this makes no difference.
        noise_scale: Learnt size of the unknown noise, and its sensitivities; None if the filter is not adaptive.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> kalman = observers.IntrinsicKalman(models.oscillator(), 1.0, 1e-4, 4.0, observers.sensor_bias(0.1))
        >>> state = kalman.init(np.array([0.1]))
        >>> state.slow.tolist(), state.root.shape
        ([0.0], (3, 3))
    """

    q: Inexact[Array, "..."]
    v: Vector
    t: Scalar
    slow: SlowVector
    root: Float[Array, "two_n_k two_n_k"]
    gate: GateMemory
    last_input: LastInput = None
    readings: Readings | None = None
    sensor_gates: tuple[GateMemory, ...] = ()
    missing_input: Bool[Array, "m"] | None = None
    noise_scale: NoiseScale | None = None


class KalmanInfo(NamedTuple):
    """Diagnostics of a step of an `IntrinsicKalman`.

    Attributes:
        innovation: Difference (n,) from the predicted configuration to the measurement without its estimated offset,
            0 where it is missing.
        distance: Length of the innovation in the metric.
        innovation_cov: Predicted covariance (n, n) of the innovation.
        nis: Normalised innovation squared, `rᵀS⁻¹r` of the measured components. If the model is right, it is
            χ²-distributed with as many degrees of freedom as there are measured components.
        velocity_std: Standard deviations (n,) of the velocity after the correction.
        slow: Estimated slow states (k,), in the order of the observer's `slow_names`.
        slow_std: Standard deviations (k,) of the slow states.
        result: A `covariant.signals.StepCode` code.
        sensors: Diagnostics of further sensors; None if the filter has none.
        noise_scale: Learnt variance of the unknown noise, relative to the initial setting; 1 if the filter is not
            adaptive.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> kalman = observers.IntrinsicKalman(models.oscillator(), 1.0, 1e-4, 1.0, substeps=1)
        >>> record = Record(np.array([0.0, 0.01]), np.zeros((2, 1)), np.array([[0.1], [0.11]]))
        >>> run = observers.run(kalman, record)
        >>> run.info.innovation[1].round(3).tolist(), round(run.info.nis[1].item(), 1), run.info.slow[1].shape
        ([0.01], 0.3, (0,))
    """

    innovation: Vector
    distance: Scalar
    innovation_cov: Matrix
    nis: Scalar
    velocity_std: Vector
    slow: SlowVector
    slow_std: SlowVector
    result: Code
    sensors: SensorInfo | None = None
    noise_scale: Scalar | float = 1.0


class MeasuredOutput(NamedTuple):
    """A measurement without its estimated offset, linearised at the estimate.

    Attributes:
        y: The measurement with the estimated offset removed.
        noise: Covariance (n, n) of its noise in the frame at the estimate.
        slope: Derivative (n, k) of the measurement with respect to the slow states; None without an offset.
    """

    y: Array
    noise: Matrix
    slope: Float[Array, "n k"] | None

    def projected(self, root: Float[Array, "N N"], n: int) -> Float[Array, "n N"]:
        """Product of the output matrix H (n, N), from the error to the measurement, with a root of the covariance."""
        return root[:n] if self.slope is None else root[:n] + self.slope @ root[2 * n :]


def as_quantum(value: Any) -> Any:
    """Array (n,) of one tick of each encoder, from a number, a sequence or an array; None stays None."""
    return None if value is None else jnp.atleast_1d(jnp.asarray(value, float))


class IntrinsicKalman(AbstractMechanicalFilter):
    """Kalman filter of a `MechanicalSystem` on any space, with error and covariance in the parallel frame.

    Each covariance is a matrix (n, n) in the frame, equal everywhere; a function of the configuration; or a number, a
    variance in metric units that is equal in all directions.

    After a gap so long that an angle may have any value, the filter restarts from the measured configuration and the
    predicted velocity, and `result` is `RESTARTED`. Its slow states are then as uncertain as at the start. In other
    coordinates, with noise that is the same tensor, the estimate is the same up to the accuracy of the budget.

    It is the most accurate choice if the noise is known: for large initial errors, gaps and outliers, and for further
    sensors, external forces, biases and parameters. It costs more than observers with constant gains, and has no
    certificate. `EKF` is the usual filter, for comparison.

    Attributes:
        model: Mechanical system, in coordinates or on a Lie group.
        process_cov: Spectral density of the white acceleration noise [(rad/s²)² s, or (m/s²)² s].
        measurement_cov: Covariance of the noise of one sample [rad² or m²].
        initial_velocity_cov: Covariance of the initial velocity, whose mean is zero [(rad/s)² or (m/s)²].
        slow: Slow states that are estimated along with the motion, a `SlowVariables` or several: `external_force`,
            `sensor_bias`, `uncertain_parameters`, or your own. A constant disturbance that is modelled so
            causes no bias if the measurements determine it. None by default.
        quantum: One tick of each encoder (n,), in coordinates [their unit]. A reading is then an interval, and a change
            of the reading means that an edge was passed; `measurement_cov` is the covariance of the positions of edges.
            None (default) if every sample has independent noise.
        sensors: Sensors in addition to the measured configuration, a `Sensor` or several, such as `gyro`. A measurement
            is then one vector: the entries of the configuration, followed by the readings, NaN for a missing one; see
            `Sensor`. None by default.
        gate: Gate that refuses measured configurations as outliers; None refuses nothing. See `Gate`.
        inputs: Model of inputs while they are missing, a `MissingInputs`; None (default) holds the last input and
            assumes it to be exact.
        budget: Work spent on geodesics, from the estimate to the measurement and along the correction.
        substeps: Runge–Kutta steps in each sample; None (default) uses as many as dt and the friction need (offline).
        adaptive: Whether the filter learns the size of the unknown noise from its innovations: that of the forces in
            `slow` that have a `time`, or of `process_cov` if there are none. The settings are then lower bounds, and
            the covariance grows if the log shows more. False by default.

    Raises:
        ValueError: A covariance is not valid, the measurement covariance is singular, the slow states do not
            fit the model, a tick is not positive, or the model with a `quantum` is not in coordinates.

    Example:
        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> kalman = observers.IntrinsicKalman(models.oscillator(), 1e-3, 1e-4, 1.0, substeps=1)
        >>> record = Record(np.array([0.0, 0.1]), np.zeros((2, 1)), np.array([[1.0], [np.cos(0.1)]]))
        >>> run = observers.run(kalman, record)
        >>> run.estimate[1].round(3).tolist()
        [0.995, -0.1]
    """

    model: MechanicalSystem
    process_cov: Covariance = eqx.field(converter=as_gain)
    measurement_cov: Covariance = eqx.field(converter=as_gain)
    initial_velocity_cov: Covariance = eqx.field(converter=as_gain)
    slow: tuple[SlowVariables, ...] = eqx.field(default=(), converter=as_groups)
    quantum: Vector | None = eqx.field(default=None, converter=as_quantum)
    gate: Gate | None = Gate()
    budget: Budget = eqx.field(default=Budget(newton=1, steps=2), static=True)
    substeps: int | None = eqx.field(default=None, static=True)
    sensors: tuple[Sensor, ...] = eqx.field(default=(), converter=as_groups)
    inputs: MissingInputs | None = None
    adaptive: bool = eqx.field(default=False, static=True)

    def __check_init__(self):
        check_covariance("IntrinsicKalman", "measurement_cov", self.measurement_cov, positive=True)
        for name in ("process_cov", "initial_velocity_cov"):
            check_covariance("IntrinsicKalman", name, getattr(self, name))
        SlowStates(self.slow).check("IntrinsicKalman", self.model)
        self._sensors.check("IntrinsicKalman")
        self._slow.check_names("IntrinsicKalman")
        if self.quantum is not None:
            check_positive("IntrinsicKalman", quantum=self.quantum)
            if not self.model.manifold.commuting:
                raise InputError("IntrinsicKalman: quantum is for coordinates; an attitude or pose has no ticks")

    def init(self, y: Array, t: Number = 0.0) -> KalmanState:
        """State at rest at a measured configuration; readings of sensors are ignored at the start.

        Args:
            y: First measurement, whose configuration is complete.
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.

        Raises:
            ValueError: y is not a configuration, followed by the readings of the sensors if there are any.
        """
        q, v, t, last_input, _ = at_rest(self.model, self._split(y)[0], t)
        slow, readings = self._slow.first(v), self._first_readings(q, jnp.zeros_like(v))
        q = self._without_offset(q, v, slow)
        present = ~self.model.manifold.missing(self._split(y)[0])
        root = self._first_root(q, present, self._velocity_cov(q), slow)
        gates = self._sensors.at_start(v)
        missing = None if self.inputs is None else jnp.zeros(self.inputs.mean.shape, bool)
        scale = NoiseScale.at_start(root) if self.adaptive else None
        return KalmanState(q, v, t, slow, root, GateMemory.at_start(v), last_input, readings, gates, missing, scale)

    def admitted(self, y: Array) -> Array:
        configuration, readings = self._split(y)
        return self._sensors.joined(super().admitted(configuration), readings)

    def configuration(self, y: AnyArray) -> Any:
        return self._split(y)[0]

    def velocity_std(self, state: KalmanState) -> Vector:
        """Standard deviations (n,) of the components of the velocity [rad/s or m/s] in a state.

        They refer to v − v̂, whose components are in the frames at two configurations, and not to ν.
        """
        n = state.v.shape[0]
        root = apart(self.model.space, state.q, state.v)[n:] @ state.root[: 2 * n]
        return jnp.sqrt(jnp.sum(root**2, axis=1))

    @property
    def slow_names(self) -> tuple[str, ...]:
        """Names (k) of the slow states, in the order of `KalmanInfo.slow`."""
        return SlowStates(self.slow + self._sensors.slow).names

    def _predicted(
        self, state: KalmanState, u: Float[Array, "m"], dt: Scalar, carry: bool
    ) -> tuple[KalmanState, Matrix | None]:
        count = self.substeps
        if count is None:
            count = needed_substeps(self.model, state.t, state.q, state.v, u, dt)
        # The covariance is linearised at every Runge–Kutta step, instead of once over dt.
        h = dt / jnp.asarray(count, state.v.dtype)
        state = self._with_known_inputs(state, u, dt)
        start = state, state.root if carry else None
        return jax.lax.fori_loop(0, count, lambda _, now: self._runge_kutta_step(now[0], now[1], u, h), start)

    def _expected(self, state: KalmanState, u: Float[Array, "m"], y: Array) -> Expectation:
        configuration, readings = self._split(y)
        manifold, output = self.model.manifold, self._output(state, configuration)
        missing = manifold.missing(output.y)
        projected = output.projected(state.root, state.v.shape[0])
        cov = projected @ projected.T + output.noise
        # A restart needs a complete configuration.
        lost = _too_uncertain(manifold, cov, output.noise) & jnp.all(manifold.told(state.q, ~missing))
        innovation = manifold.ambient.towards(state.q, output.y)
        sensed = self._sensed(state, u, readings) if self.sensors else None
        return Expectation(output.y, innovation, cov, output.noise, ~missing, lost, (output, sensed))

    def _split(self, y: AnyArray) -> tuple[Any, Any]:
        """The measured configuration, and the readings of further sensors (K,)."""
        return self._sensors.split(y, self.model.manifold.shape)

    def _sensed(self, state: KalmanState, u: Float[Array, "m"], readings: Array) -> Sensed:
        frame = _with_slow(apart(self.model.space, state.q, state.v), state)
        with_slow = functools.partial(self._slow.in_model, self.model)
        return self._sensors.sensed(self.model, state, u, frame, readings, with_slow)

    def _usual_velocity(self, state: KalmanState) -> Matrix:
        return self._velocity_cov(state.q)

    def _used(self, state: KalmanState, y: Array, expected: Expectation, used: Bool[Array, "n"]) -> Used:
        output, sensed = expected.details
        y = self._split(y)[0]
        error, root = self._posterior(state, output, y, expected.innovation, used)
        if sensed is not None:
            error, root = sensed.posterior(error, root)
            state = state._replace(sensor_gates=sensed.gates)
        moved, reset = self.moved(state, error)
        readings = None
        if state.readings is not None:
            readings = Readings(jnp.where(used, y, state.readings.y), jnp.where(used, 0.0, state.readings.age))
        return Used(moved._replace(root=reset @ root, readings=readings), error, reset)

    def _started_anew(
        self, state: KalmanState, corrected: KalmanState, y: Array, expected: Expectation, velocity: Velocity
    ) -> KalmanState:
        q, n = self._start(state, expected), state.v.shape[0]
        present = self.model.manifold.told(q, expected.present)
        # The measurement was corrected by the offset from the predicted slow states, so these states are kept.
        root = self._first_root(q, expected.present, velocity.cov, state.slow)
        present_rows = jnp.where(present[:, None], root[:n], 0.0)
        position = semidefinite_root(
            with_block(state.root[:n] @ state.root[:n].T, root[:n, :n] @ root[:n, :n].T, present)
        )
        root = root.at[:n].set(present_rows).at[:n, :n].set(position)
        readings, y = state.readings, self._split(y)[0]
        if readings is not None:
            read = expected.present
            readings = Readings(jnp.where(read, y, readings.y), jnp.where(read, 0.0, readings.age))
        return corrected._replace(q=q, v=velocity.mean, slow=state.slow, root=root, readings=readings)

    def _info(self, state: KalmanState, new: KalmanState, expected: Expectation, result: Code) -> KalmanInfo:
        _, innovation, cov, _, present, *_ = expected
        nis = normalised_square(cov, innovation, present)
        distance = self.model.space.norm(state.q, innovation)
        sensed = expected.details[1]
        sensors = None if sensed is None else sensed.info
        known = self.deviations(new) | {"noise_scale": factor_of(new.noise_scale, nis)}
        return KalmanInfo(innovation, distance, cov, nis, **known, result=result, sensors=sensors)

    def _result(self, state: KalmanState, new: KalmanState, y: Array, expected: Expectation, verdict: Judged) -> Code:
        configuration, sensed = self._split(y)[0], expected.details[1]
        if sensed is None:
            return super()._result(state, new, configuration, expected, verdict)
        # A step with readings only, between two measured configurations, is not missing a measurement.
        between = sensed.read & jnp.all(self.model.manifold.missing(configuration))
        measured: Any = jnp.where(between, state.q, configuration)
        code = super()._result(state, new, measured, expected, verdict)
        return jnp.maximum(code, jnp.where(sensed.refused, int(StepCode.OUTLIER), 0).astype(code.dtype))

    @property
    def _sensors(self) -> Sensors:
        return Sensors(self.sensors)

    @property
    def _slow(self) -> SlowStates:
        return self._slow_over(None, None)

    def _slow_over(self, missing: Bool[Array, "m"] | None, u: Vector | None) -> SlowStates:
        """The slow states over a step with the inputs u, some of which are missing."""
        if self.inputs is None:
            return SlowStates(self.slow + self._sensors.slow)
        zeros = jnp.zeros_like(self.inputs.mean)
        states = InputStates(self.inputs, zeros > 0 if missing is None else missing, zeros if u is None else u)
        return SlowStates((*self.slow, states, *self._sensors.slow))

    @property
    def _inputs_at(self) -> slice:
        """Positions of the states of missing inputs among the slow states."""
        first = sum(len(group.names) for group in self.slow)
        return slice(first, first + (0 if self.inputs is None else 2 * len(self.inputs.mean)))

    def _with_known_inputs(self, state: KalmanState, u: Float[Array, "m"], dt: Scalar) -> KalmanState:
        """The state at the start of a step, with the flags of missing inputs, and with the inputs known there."""
        if self.inputs is None or state.missing_input is None:
            return state
        missing, at = missing_now(self.inputs, state.missing_input, dt), self._inputs_at
        # At the start of a stretch of missing rows, the input is known for the last time.
        known = jnp.concatenate([missing & ~state.missing_input, jnp.zeros_like(missing)])
        deviation = jnp.concatenate([u - self.inputs.mean, jnp.zeros_like(u)]).astype(state.slow.dtype)
        slow = state.slow.at[at].set(jnp.where(known, deviation, state.slow[at]))
        rows = slice(2 * state.v.shape[0] + at.start, 2 * state.v.shape[0] + at.stop)
        root = state.root.at[rows].set(jnp.where(known[:, None], 0.0, state.root[rows]))
        return state._replace(slow=slow, root=root, missing_input=missing)

    def _slow_estimates(self, state: KalmanState) -> tuple[SlowVector, SlowVector]:
        """Values of the slow states (k,) as `SlowVariables.values` reports them, and their standard deviations (k,)."""
        at, every = self._inputs_at, self._slow

        def reported(slow):
            values = every.values(slow)
            return jnp.concatenate([values[: at.start], values[at.stop :]])

        values = reported(state.slow)
        slope = jax.jacfwd(reported)(state.slow)
        return values, jnp.sqrt(jnp.sum((slope @ state.root[2 * state.v.shape[0] :]) ** 2, axis=1))

    def _noise(self, q: Array) -> Matrix:
        """Covariance (n, n) of one sample, in the frame at the measured configuration q."""
        # The variance of a uniform distribution over one tick is quantum²/12.
        noise = covariance_at(self.measurement_cov, self.model.space, q)
        return noise if self.quantum is None else noise + jnp.diag(self.quantum.astype(noise.dtype) ** 2 / 12)

    def _first_readings(self, y: Array, age: Vector) -> Readings | None:
        return None if self.quantum is None else Readings(y, age)

    def _without_offset(self, y: Array, like: Vector, slow: SlowVector) -> Array:
        """The configuration of which y is the measurement, with the estimated offset removed."""
        return self.model.manifold.ambient.retract(y, -self._slow.offset(slow, like)) if self._slow.measured else y

    def _output(self, state: KalmanState, y: Array) -> MeasuredOutput:
        without_offset = self._without_offset(y, state.v, state.slow)
        return MeasuredOutput(without_offset, *self._slopes(state.q, state.v, state.slow))

    def _slopes(self, q: Array, like: Vector, slow: SlowVector) -> tuple[Matrix, Float[Array, "n k"] | None]:
        """Noise (n, n) in the frame at q of a measurement without offset, and its slope (n, k) in the slow states."""
        # With noise w, y = retract(retract(q, offset), w); the estimated offset is removed.
        if not self._slow.measured:
            return self._noise(q), None
        manifold, k = self.model.manifold.ambient, slow.shape[0]

        def innovation(change):
            true = manifold.retract(q, self._slow.offset(slow + change[:k], like))
            return manifold.local(q, self._without_offset(manifold.retract(true, change[k:]), like, slow))

        slopes = jax.jacfwd(innovation)(jnp.zeros(k + like.shape[0], like.dtype))
        measured_at = manifold.retract(q, self._slow.offset(slow, like))
        return slopes[:, k:] @ self._noise(measured_at) @ slopes[:, k:].T, slopes[:, :k]

    def _posterior(
        self, state: KalmanState, output: MeasuredOutput, y: Array, straight: Vector, used: Array
    ) -> tuple[Array, Array]:
        """Posterior mean (2n + k,) of the error after the sample, and the square root of its covariance."""
        space, n = self.model.space, state.v.shape[0]
        if self.quantum is None or state.readings is None:
            gain, root = updated(state.root, output.projected(state.root, n), output.noise, used)
            return gain @ jnp.where(used, self._displacement(state, output.y, straight, used), 0.0), root
        # Encoders measure coordinates: these rows map (ε, ν, slow) to position and velocity differences in them.
        rows = _with_slow(apart(space, state.q, state.v), state)
        position = rows[:n] if output.slope is None else rows[:n].at[:, 2 * n :].set(output.slope)
        moved = self.model.manifold.ambient.towards(state.readings.y, y)
        noise = jnp.diag(covariance_at(self.measurement_cov, space, state.q))
        parts = position, rows[n : 2 * n]
        step = self.quantum.astype(noise.dtype)
        return take(state.root, parts, Encoded(straight, moved, state.readings.age, state.v, step, noise, used))

    def _displacement(self, state: KalmanState, y: Array, straight: Vector, used: Array) -> Vector:
        """Geodesic `log_q̂ y` (n,); where an entry of y is not used, the coordinate difference `straight` instead."""
        geodesic = self.model.space.shoot(
            state.q, self.model.manifold.ambient.measured(state.q, y), straight, self.budget
        )
        reached = jnp.all(jnp.isfinite(geodesic.velocity)) & (geodesic.result != StepCode.NOT_CONVERGED)
        # If the geodesic has not converged, the coordinate difference, equal to first order, replaces it.
        return jnp.where(reached & jnp.all(used), geodesic.velocity, straight)

    def _runge_kutta_step(
        self, state: KalmanState, carried: Matrix | None, u: Float[Array, "m"], h: Scalar
    ) -> tuple[KalmanState, Matrix | None]:
        """One Runge–Kutta step of model and covariance, and of a matrix `carried` that is only multiplied by the
        transition."""
        space, manifold, n = self.model.space, self.model.manifold, state.v.shape[0]
        states, at = self._slow_over(state.missing_input, u), self._inputs_at

        def acting(mean):
            return u if self.inputs is None else states.groups[len(self.slow)].acting(u, mean[at])

        def model(mean):
            return states.in_model(self.model, mean)

        (q, v, slow), slope = flow_with_slope(manifold, model, acting, states, state[:4], h)
        start, end = jax.vmap(functools.partial(parallel, space))(jnp.stack([state.q, q]), jnp.stack([state.v, v]))
        # From right to left: parallel frame to frame at the start, flow, frame to parallel frame at the end.
        transition = _with_slow(end, state) @ slope @ _with_slow(inverse(start), state)
        transition = space.between(state.q, q, transition)
        noise = white_acceleration(covariance_along(self.process_cov, space, q), h)
        if state.slow.shape[0]:
            noise = diagonal(noise, states.walk_root(state.v, h).astype(noise.dtype))
        forces = states.forgotten_forces
        unknown = jnp.asarray([not any(forces)] * (2 * n) + forces)[:, None]
        noise, scale = scaled(state.noise_scale, transition, noise, unknown)
        readings = state.readings and state.readings._replace(age=state.readings.age + h)
        # Roots side by side give the sum of both covariances; their triangular factor is square again.
        root = triangular(jnp.concatenate([transition @ state.root, noise], axis=1))
        gate = state.gate.advanced(h)
        new = state._replace(
            q=q, v=v, t=state.t + h, slow=slow, root=root, gate=gate, readings=readings, noise_scale=scale
        )
        return new, None if carried is None else transition @ carried

    def moved(self, state: KalmanState, error: Float[Array, "two_n_k"]) -> Moved:
        """Move the estimate along the geodesic of an error, which transports the velocity.

        Args:
            state: The state; its covariance is not changed.
            error: Error (2n + k,) by which the estimate is moved, in the parallel frame.

        Returns:
            The moved state, and the reset, which is the derivative of this map.
        """
        space, manifold, n = self.model.space, self.model.manifold, state.v.shape[0]

        def corrected(e):
            end = space.transport_along(state.q, e[:n], state.v + e[n:], self.budget)
            return jnp.concatenate([manifold.local(jax.lax.stop_gradient(end.q), end.q), end.w]), (end.q, end.w)

        slope, (q, v) = jax.jacfwd(corrected, has_aux=True)(error[: 2 * n])
        reset = space.between(state.q, q, _with_slow(parallel(space, q, v) @ slope, state))
        return Moved(state._replace(q=q, v=v, slow=state.slow + error[2 * n :]), reset)

    def regular_root(self, state: KalmanState) -> Float[Array, "two_n_k K"]:
        return with_part_across(self.model.space, state.q, state.root, len(state.v))

    def deviations(self, state: KalmanState) -> dict[str, Vector]:
        slow, slow_std = self._slow_estimates(state)
        return {"velocity_std": self.velocity_std(state), "slow": slow, "slow_std": slow_std}

    def _velocity_cov(self, q: Array) -> Matrix:
        """Covariance (n, n) of the initial velocity, in the frame at the configuration q."""
        return covariance_along(self.initial_velocity_cov, self.model.space, q)

    def _first_root(
        self, q: Array, present: Bool[Array, "n"], velocity_cov: Matrix, slow: SlowVector
    ) -> Float[Array, "two_n_k two_n_k"]:
        """Root of the covariance after a single measurement, from its noise and the covariance of the velocity."""
        noise, slope = self._slopes(q, velocity_cov[0], slow)
        shown = jax.vmap(lambda e: self.model.manifold.shown(q, present, e), in_axes=1, out_axes=1)
        velocity = semidefinite_root(velocity_cov)
        motion_root = diagonal(shown(semidefinite_root(noise)), velocity)
        if not slow.shape[0]:
            return motion_root
        slow_root = self._slow.first_root().astype(motion_root.dtype)
        root = diagonal(motion_root, slow_root)
        # The estimate is the measurement minus its offset, so an error of the offset enters with the opposite sign.
        return root if slope is None else root.at[: len(velocity), 2 * len(velocity) :].set(shown(-slope @ slow_root))


def _with_slow(matrix: Array, state: KalmanState) -> Array:
    """A matrix for (ε, ν), extended to one for (ε, ν, slow) that leaves the slow states unchanged."""
    return diagonal(matrix, jnp.eye(state.slow.shape[0], dtype=matrix.dtype))


def _too_uncertain(manifold: AbstractManifold, cov: Matrix, noise: Matrix) -> Array:
    """Whether the expected error of an angle is so large, beyond its noise, that linearisation fails."""
    angles = sorted({i for rotation in manifold.rotations or () for i in rotation})
    variance = jnp.diag(cov)[jnp.array(angles, int)]
    # The variance includes the noise, so the bound grows with it: a noisy sensor alone must not cause a restart.
    return jnp.any(variance > jnp.maximum(FARTHEST_TURN**2, 9 * jnp.diag(noise)[jnp.array(angles, int)]))
