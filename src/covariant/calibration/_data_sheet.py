"""What estimators are tuned by: a data sheet, and part of a log for those that use no model."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.observers import Slow


class DataSheet(NamedTuple):
    """What is known of sensor, model and motion before any log is recorded; in units of the coordinates and seconds.

    On a group each number holds for every component of a vector in the body frame, in rad and, for positions, m.

    - `measurement_std`: standard deviation of the noise of one sample.
    - `acceleration_std`, `correlation_time`: standard deviation and correlation time of the acceleration that the model
      does not explain; None for one that is independent at each sample.
    - `motion_std`, `motion_time`: the same of the acceleration of the motion itself, for filters that use no model.
    - `damping`: damping ratio ζ of the observers.
    - `natural_frequency` [rad/s]: ω of their gains α = 2ζω and β = ω²; None where it is designed from the noise.
    - `coordinate_stds`: standard deviations of the noise of each coordinate, where they differ; `measurement_std` is
      then their root mean square, for designs that know one number only.
    - `quantum`: one tick of the encoders, or one for each coordinate, where that is what makes the noise; then
      `measurement_std`, and `coordinate_stds` for several, are this over √12.
    - `external_force`: standard deviation of what a force that the model does not know changes by in a second [N or
      N m]; None where no such force is estimated.
    - `slow`: further slow states that are estimated along with the motion, as `observers.sensor_bias`.
    - `speed`: usual size of each velocity, as of `usual_speeds`, by which gates judge; None where it is not known.
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
    slow: tuple[Slow, ...] = ()

    @property
    def speeds(self) -> Float[np.ndarray, "*n"]:
        """The usual size of the velocities: those of `speed`, and no less than `motion_std · motion_time`."""
        return np.asarray(np.maximum(self.motion_std * self.motion_time, self.speed or 0.0))


class Trial(NamedTuple):
    """Part of a log on which the filters without a model are tuned.

    - `t` (T,): stamps [s].
    - `y` (T, n): positions, continuous across full turns; entries may be missing (NaN).
    - `v` (T, n): velocities to compare with.
    """

    t: Float[np.ndarray, "T"]
    y: Float[np.ndarray, "T n"]
    v: Float[np.ndarray, "T n"]
