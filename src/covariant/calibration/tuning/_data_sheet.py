"""What estimators are tuned from: a data sheet, and part of a log for filters that use no model."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.observers import MissingInputs, Sensor, SlowVariables


class DataSheet(NamedTuple):
    """Numbers on sensor, model and motion, known before any log is recorded, in units of the coordinates and seconds.

    On a group each number holds for every component of a vector in the body frame, in rad and, for positions, m.

    Attributes:
        measurement_std: Standard deviation of the noise of one sample.
        acceleration_std: Standard deviation of the acceleration that the model does not explain.
        correlation_time: Correlation time [s] of that acceleration; None where it is independent at each sample.
        motion_std: Standard deviation of the acceleration of the motion itself, for filters that use no model.
        motion_time: Correlation time [s] of that acceleration.
        damping: Damping ratio ζ of the observers.
        quantum: One tick of the encoders, or one for each coordinate, where ticks make the noise; then
            `measurement_std`, and `coordinate_stds` for several, are this over √12. None for a sensor without ticks.
        coordinate_stds: Standard deviation of the noise of each coordinate, where they differ; then `measurement_std`
            is their root mean square, for designs that use one number only.
        external_force: Standard deviation of the change in one second of a force that the model does not know [N or
            N m]; None where no such force is estimated.
        speed: Usual size of each velocity, as from `usual_speeds`, by which gates judge; None where it is unknown.
        natural_frequency: ω [rad/s] of the gains α = 2ζω and β = ω²; None where it is designed from the noise.
        force_rate: Rate ρ [1/s] at which `IntrinsicForce` learns an unknown force; None where it is designed from the
            size and time of that force.
        external_force_std: Usual size of a force that the model does not know and that is forgotten [N or N m], one for
            all components or one for each; None where no such force is estimated.
        external_force_time: Its time constant [s]; both or neither.
        slow: Further slow states to estimate along with the motion, as `observers.sensor_bias`.
        sensors: Sensors beside the measured configuration, as `observers.gyro`, for filters that use them.
        torque_std: Standard deviation of the torques or forces that the model does not explain [N m or N], one for all
            velocities or one for each, beside that of the acceleration and with its correlation time; for filters
            whose noise may depend on the configuration, `intrinsic-kalman` and `ukf`. None for none.
        inputs: What inputs may be while they are missing, from `missing_inputs`; None where they never are.
        gains_and_speed: α [1/s] and β [1/s²] of `measured-coefficients`, and the speeds to which it clips if these are
            known, each a number or (n,), such as `certify` finds; None where its gains are those of the others.

    Example:
        >>> from covariant.calibration import DataSheet, observer_gains
        >>> sheet = DataSheet(measurement_std=1e-3, acceleration_std=1.0, correlation_time=0.5)
        >>> round(observer_gains(sheet, rate=100.0).beta)
        10000
    """

    measurement_std: float
    acceleration_std: float
    correlation_time: float | None = None
    motion_std: float = 10.0
    motion_time: float = 0.1
    damping: float = 0.5**0.5
    quantum: float | tuple[float, ...] | None = None
    coordinate_stds: tuple[float, ...] | None = None
    external_force: float | None = None
    speed: tuple[float, ...] | None = None
    natural_frequency: float | None = None
    force_rate: float | None = None
    slow: tuple[SlowVariables, ...] = ()
    external_force_std: float | tuple[float, ...] | None = None
    external_force_time: float | None = None
    sensors: tuple[Sensor, ...] = ()
    torque_std: float | tuple[float, ...] | None = None
    inputs: MissingInputs | None = None
    gains_and_speed: tuple[Any, ...] | None = None

    def white_time(self, rate: float) -> float:
        """Time τ [s] for which acceleration noise σ acts as white noise of the density 2σ²τ, at a rate [Hz]."""
        # Independent at each sample: the density is then σ²/rate, as for the measurement.
        return 1 / (2 * rate) if self.correlation_time is None else self.correlation_time

    def stds(self, n: int) -> Float[np.ndarray, "n"]:
        """Standard deviation of the noise of each of n coordinates."""
        return np.broadcast_to(np.asarray(self.coordinate_stds or self.measurement_std, float), n)

    @property
    def speeds(self) -> Float[np.ndarray, "*n"]:
        """Usual size of the velocities: `speed`, but no less than `motion_std · motion_time`."""
        return np.asarray(np.maximum(self.motion_std * self.motion_time, self.speed or 0.0))


class Trial(NamedTuple):
    """Part of a log on which filters without a model are tuned.

    Observers without a model have one bandwidth or window, and the best one depends on the motion. `tuned_estimators`
    tries them on this part of a log. Take a part of typical motion, and judge the result on another one.

    Attributes:
        t: Stamps (T,) [s].
        y: Positions (T, n), continuous across full turns; NaN where missing.
        v: Reference velocities (T, n) to compare with.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration import DataSheet, Trial, filter_error
        >>> from covariant.observers import SavitzkyGolay
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> trial = Trial(t, np.sin(t)[:, None], np.cos(t)[:, None])
        >>> filter_error(SavitzkyGolay(4).weights(100.0), DataSheet(1e-3, 1.0), 100.0, trial) < 1e-3  # without noise
        True
    """

    t: Float[np.ndarray, "T"]
    y: Float[np.ndarray, "T n"]
    v: Float[np.ndarray, "T n"]
