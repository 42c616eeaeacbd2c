"""Velocity sensors for constant gains: a damper between the estimate and the readings of tachometers and gyros.

A sensor whose reading is linear in the velocity, `w = J(q)v + b` with an offset b, is joined to the observer by a
damper of the coefficients Γ ≥ 0, a force `JᵀΓ` times the difference, and adapts the estimate of the offset:

    v̂' = … − M⁻¹Jᵀ Γ r,   b̂' = −γ Γ r,   r = J v̂ + b̂ − w

The gain `K_v = M⁻¹JᵀΓJ` is self-adjoint in the metric M and positive semidefinite: to first order in the error,
`V = β|ξ|² + |ζ|²` falls by `2<ζ, K_v ζ>` faster than without the damper. A gain that is not self-adjoint, such as a
diagonal matrix in some chart, has no such guarantee. With dt the times since the readings were last taken, a sample
makes an implicit Euler step,

    (v̂, b̂) ← (v̂, b̂) − (M⁻¹Jᵀ, γ) (Γ⁻¹/dt + J M⁻¹ Jᵀ + γ)⁻¹ r,

for which `|δv|² + δbᵀγ⁻¹δb`, between two estimates at one configuration, never grows, for any Γ and dt.

Source: Aghannan & Rouchon 2003, section III, for V without the damper; Rockafellar 1976, Monotone operators and the
proximal point algorithm, SIAM J. Control Optim. 14(5), proposition 1, for the step: it is the resolvent of a monotone
operator.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._linalg import solve
from covariant._typing import Code, Number, Scalar, Vector
from covariant.models import MechanicalSystem, Motion
from covariant.observers.base import (
    AbstractMechanicalObserver,
    AbstractObserver,
    Fields,
    LastInput,
    check_not_negative,
    check_positive,
    no_input,
    with_velocity,
)
from covariant.observers.sensors import Instant, Readings, Sensor, Sensors, as_groups
from covariant.observers.wrappers._gated import Gated, without_last_input
from covariant.signals import AnyArray, StepCode
from scalargraph.errors import InputError


class DampedState(NamedTuple):
    """State of a `Damped` observer.

    Attributes:
        inner: State of the observer with the constant gains.
        t: Time [s] of the state.
        bias: Estimated offsets (K,) of the readings.
        waited: Time (K,) since each reading was last taken [s].
        last_input: The last finite input (m,).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> inner = observers.Intrinsic(models.oscillator(), alpha=4.0, beta=8.0)
        >>> observer = observers.Damped(inner, observers.tachometer([0], 0.01), damping=5.0)
        >>> state = observer.init(jnp.array([0.5, jnp.nan]))  # the position, and no reading
        >>> state.inner.q.tolist(), state.bias.tolist()
        ([0.5], [0.0])
    """

    inner: Fields
    t: Scalar
    bias: Readings
    waited: Float[Array, "K"]
    last_input: LastInput = None


class DampedInfo(NamedTuple):
    """Diagnostics of a step of a `Damped` observer.

    Attributes:
        innovation: Difference (n,) from q̂ to the measured configuration before the correction, as in `Info`.
        distance: Its length in the metric, as the inner observer computes it.
        sensor_innovation: Readings minus expected readings (K,), after the correction by the configuration; 0 for a
            missing reading.
        bias: Estimated offsets (K,) of the readings.
        result: A `covariant.signals.StepCode` code.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> inner = observers.Intrinsic(models.oscillator(), alpha=4.0, beta=8.0)
        >>> observer = observers.Damped(inner, observers.tachometer([0], 0.01), damping=5.0)
        >>> state = observer.init(jnp.array([0.0, jnp.nan]))
        >>> _, info = observer.step(state, jnp.zeros(1), jnp.array([jnp.nan, 2.0]), 0.01)
        >>> info.sensor_innovation.tolist()
        [2.0]
    """

    innovation: Vector
    distance: Scalar
    sensor_innovation: Readings
    bias: Readings
    result: Code


class Damped(AbstractObserver):
    """An observer with constant gains that also uses velocity sensors, by a damper between estimate and readings.

    A measurement is one vector: the entries of the configuration, and then the readings, NaN where there is none. The
    configuration corrects the estimate as it does without sensors; the readings then correct the velocity. A reading
    acts for the whole time since the previous one of its sensor, so sensors may have different rates. Without a reading
    the result is that of the inner observer, to the last bit. Noise and gates of the sensors are not used: unlike a
    filter, the observer weighs the readings by Γ alone.

    `init` checks that each sensor is linear in the velocity, except in a compiled function. A sensor that is not linear
    corrects the velocity along its derivative, without the guarantee.

    Attributes:
        observer: Observer whose state holds the velocity, such as `Intrinsic` or `Geodesic`, or a `Gated` one.
        sensors: One or several sensors whose readings are linear in the velocity, such as `tachometer` and `gyro`. They
            have no slow states: their offsets are estimated with `bias_gain`.
        damping: Damping coefficients Γ of the readings, one number or (K,) [N m s for readings in rad/s, N s/m for
            those in m/s]. On a joint of inertia m the error of the velocity decays with Γ/m [1/s].
        bias_gain: Gains γ of the offsets, one number or (K,) [1/(kg m²) or 1/kg]. The error of an offset decays with
            about `γΓ β/(β + ακ)` [1/s], κ = Γ/m, if this is slow compared with the other gains. 0 (default) for a
            sensor without offset.

    Raises:
        ValueError: The observer has no velocity, there is no sensor or one is not linear, `damping` is not positive,
            `bias_gain` is negative, or a gain is not finite or not one number or K numbers. `init` raises it if the
            measurement is not a configuration with K readings, or a sensor is not linear in the velocity.

    Example:
        A unit mass on a unit spring, whose tachometer reads 0.2 m/s too much:

        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 20.0, 2001)
        >>> y = np.column_stack([np.cos(t), 0.2 - np.sin(t)])
        >>> inner = observers.Intrinsic(models.oscillator(), alpha=4.0, beta=8.0)
        >>> damped = observers.Damped(inner, observers.tachometer([0], 0.01), damping=5.0, bias_gain=0.2)
        >>> run = observers.run(damped, Record(t, np.zeros((2001, 1)), y))
        >>> run.info.bias[-1].round(2).tolist()
        [0.2]
    """

    observer: AbstractObserver
    sensors: tuple[Sensor, ...] = eqx.field(converter=as_groups)
    damping: Scalar | Readings = eqx.field(converter=jnp.asarray)
    bias_gain: Scalar | Readings = eqx.field(default=0.0, converter=jnp.asarray)

    def __check_init__(self):
        inner = self.observer.observer if isinstance(self.observer, Gated) else self.observer
        if not isinstance(inner, AbstractMechanicalObserver):
            raise InputError(
                f"Damped: observer must be Intrinsic, Geodesic or ModelCopy, or one of them behind Gated; got "
                f"{type(inner).__name__}. A filter with a covariance has sensors of its own"
            )
        if not self.sensors:
            raise InputError("Damped: sensors must be one Sensor or several, such as gyro(...); got none")
        self._sensors.check("Damped")
        for sensor in self.sensors:
            if sensor.difference is not None or sensor.period is not None:
                raise InputError(f"Damped: sensor {sensor.name} is not linear in the velocity; use tachometer or gyro")
            if sensor.slow is not None:
                raise InputError(
                    f"Damped: sensor {sensor.name} has slow states, which only a filter estimates; leave out bias_std "
                    "and give Damped a bias_gain"
                )
        check_positive("Damped", damping=self.damping)
        check_not_negative("Damped", bias_gain=self.bias_gain)
        for name in ("damping", "bias_gain"):
            shape = np.shape(getattr(self, name))
            if shape not in ((), (self._sensors.size,)):
                raise InputError(
                    f"Damped: {name} must be one number or {self._sensors.size}, one for each reading; its shape is "
                    f"{shape}"
                )

    @property
    def model(self) -> MechanicalSystem:
        """The mechanical system of the inner observer."""
        return getattr(self.observer, "model")  # noqa: B009 - that it has one is checked above

    def init(self, y: Array, t: Number = 0.0) -> DampedState:
        """State at rest at a measured configuration, with zero offsets; the first readings are ignored.

        Args:
            y: First measurement, whose configuration is complete.
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.

        Raises:
            ValueError: y is not a configuration and K readings, or a sensor is not linear in the velocity there.
        """
        q, readings = self._split(y)
        inner = without_last_input(self.observer.init(q, t))
        rest = self.model.manifold.zero(q)
        t = jnp.asarray(t, rest.dtype)
        self._check_linear(q, rest, t)
        zero = jnp.zeros(readings.shape, rest.dtype)
        return DampedState(inner, t, zero, zero, no_input(self.model, rest))

    def estimate(self, state: DampedState) -> Any:
        return self.observer.estimate(state.inner)

    def admitted(self, y: Array) -> Array:
        configuration, readings = self._split(y)
        return self._sensors.joined(self.observer.admitted(configuration), readings)

    def configuration(self, y: AnyArray) -> Any:
        return self._split(y)[0]

    def innovation(self, state: DampedState, u: Float[Array, "m"], y: Array) -> Vector:
        return self.observer.innovation(state.inner, u, self.configuration(y))

    def predict(self, state: DampedState, u: Float[Array, "m"], dt: Scalar) -> DampedState:
        inner = self.observer.predict(state.inner, u, dt)
        return state._replace(inner=inner, t=state.t + dt, waited=state.waited + dt)

    def correct(self, state: DampedState, u: Float[Array, "m"], y: Array) -> tuple[DampedState, DampedInfo]:
        configuration, readings = self._split(y)
        inner, info = self.observer.correct(state.inner, u, configuration)
        motion = self.model.motion(self.observer.estimate(inner))
        present = ~jnp.isnan(readings)
        expected, slope = self._outputs(motion, u, state.t)
        residual: Array = jnp.where(present, expected + state.bias - jnp.nan_to_num(readings), 0.0)
        coefficients = jnp.where(present, self.damping.astype(motion.v.dtype) * state.waited, 0.0)
        bias_gain = jnp.broadcast_to(self.bias_gain, residual.shape).astype(motion.v.dtype)
        v_change, bias_change = damping_step(self.model, motion.q, slope, coefficients, bias_gain, residual)
        # Without a reading the mask keeps every bit of the state, also where a chart is singular.
        read = jnp.any(present)
        v = jnp.where(read, motion.v + v_change, motion.v)
        bias = jnp.where(read, state.bias + bias_change, state.bias)
        waited = jnp.where(present, 0.0, state.waited)
        # A step with readings only, between two measured configurations, lacks no measurement.
        between = read & jnp.all(self.model.manifold.missing(configuration)) & (info.result == int(StepCode.COASTED))
        code = jnp.where(between, int(StepCode.OK), jnp.asarray(info.result))
        finite = jnp.all(jnp.isfinite(v)) & jnp.all(jnp.isfinite(bias))
        result = jnp.where(finite, code, int(StepCode.NOT_FINITE)).astype(info.result.dtype)
        new = state._replace(inner=with_velocity(inner, v), bias=bias, waited=waited)
        return new, DampedInfo(info.innovation, info.distance, -residual, bias, result)

    @property
    def _sensors(self) -> Sensors:
        return Sensors(self.sensors)

    def _split(self, y: AnyArray) -> tuple[Any, Any]:
        """The measured configuration, and the readings (K,)."""
        return self._sensors.split(y, self.model.manifold.shape)

    def _outputs(self, motion: Motion, u: Float[Array, "m"], t: Scalar) -> tuple[Readings, Float[Array, "K n"]]:
        """Expected readings (K,) without their offsets, and their derivative J (K, n) in the velocity."""

        def outputs(v: Vector) -> Readings:
            return jnp.concatenate([_reading(sensor, Motion(motion.q, v), u, t) for sensor in self.sensors])

        return outputs(motion.v), jax.jacfwd(outputs)(motion.v)

    def _check_linear(self, q: Array, rest: Vector, t: Scalar) -> None:
        """Check that the readings are affine in the velocity at q; traced numbers have no values to check."""
        u = no_input(self.model, rest)
        for sensor in self.sensors:
            values = _at_three_velocities(sensor, q, rest, u, t)
            if isinstance(values, Tracer):
                continue
            still, once, twice = np.asarray(values)
            change = np.abs(once - still).max()
            # With NaN, as at a singularity of a chart, the comparison is false and the sensor passes.
            if np.abs(twice - 2 * once + still).max() > 1e-3 * (change + np.abs(still).max()) or change == 0:
                raise InputError(
                    f"Damped: the readings of sensor {sensor.name} must be linear in the velocity; use a filter, such "
                    "as IntrinsicKalman, for other sensors"
                )


def _reading(sensor: Sensor, motion: Motion, u: Float[Array, "m"], t: Scalar) -> Vector:
    def refused() -> Vector:
        raise InputError(f"Damped: sensor {sensor.name} reads an acceleration, which is not linear in the velocity")

    return sensor.h(Instant(motion.q, motion.v, refused, u, t), motion.v[:0])


@eqx.filter_jit
def _at_three_velocities(sensor: Sensor, q: Array, rest: Vector, u: Float[Array, "m"], t: Scalar) -> Array:
    """Readings (3, j) at rest, at some velocity with different entries, and at twice that."""
    n = rest.shape[0]
    probe = 1.0 + jnp.arange(n, dtype=rest.dtype) / n
    return jax.vmap(lambda v: _reading(sensor, Motion(q, v), u, t))(jnp.stack([rest, probe, 2 * probe]))


def damping_step(
    model: MechanicalSystem,
    q: Array,
    slope: Float[Array, "K n"],
    coefficients: Readings,
    bias_gain: Readings,
    residual: Readings,
) -> tuple[Vector, Readings]:
    """Implicit Euler step of the damper, with its offsets; see this file's head."""
    raised = jax.vmap(lambda row: model.space.raise_(q, row))(slope)  # rows of (M⁻¹Jᵀ)ᵀ
    # With s² = Γ dt, (Γ⁻¹/dt + G)⁻¹ = s (1 + s G s)⁻¹ s, which also holds for coefficients of zero.
    used = coefficients > 0
    s = jnp.where(used, jnp.sqrt(jnp.where(used, coefficients, 1.0)), 0.0)  # with a finite derivative at zero
    total = slope @ raised.T + jnp.diag(bias_gain)
    impulse = s * solve(jnp.eye(len(s), dtype=s.dtype) + jnp.outer(s, s) * total, s * residual)
    return -impulse @ raised, -bias_gain * impulse


def damping_margin(alpha: Number, beta: Number, kappa: Number, cross: Number) -> Scalar:
    """Margin `4β(α − c)(c + κ) − c²(α + κ)²` of a damper; if it is positive, the error strictly decays.

    To first order the error obeys `ξ' = ζ − αξ`, `ζ' = −βξ − K_v ζ` in a parallel frame. For c between 0 and α the
    function `β|ξ|² − 2c<ξ, ζ> + |ζ|²` is positive and strictly decreases, if the margin is positive for each
    eigenvalue κ of K_v. The margin is concave in κ, so it is positive on a range of κ if it is positive at both ends.

    Args:
        alpha: Gain α [1/s].
        beta: Gain β [1/s²].
        kappa: Eigenvalue κ of K_v [1/s], 0 without a damper.
        cross: Coefficient c of the cross term [1/s].

    Returns:
        The margin [1/s⁴].

    Example:
        >>> from covariant import observers
        >>> observers.damping_margin(4.0, 8.0, kappa=5.0, cross=1.0).item()
        495.0
    """
    alpha, beta, kappa, cross = (jnp.asarray(number, float) for number in (alpha, beta, kappa, cross))
    return 4 * beta * (alpha - cross) * (cross + kappa) - cross**2 * (alpha + kappa) ** 2
