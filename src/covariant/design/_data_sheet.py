"""What estimators are tuned by: a data sheet, and part of a log for those that know no model."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class DataSheet(NamedTuple):
    """What is known of sensor, model and motion before any log is seen; units of the coordinates and seconds.

    On a group each number stands for every component of a vector as seen from the body, in rad and, for positions, m.

    `measurement_std` of one sample; `acceleration_std` of what the model leaves out, over `correlation_time` (None: new
    at each sample); `motion_std` of the accelerations of the motion itself and `motion_time` over which they change,
    for filters that know no model; `damping` ζ of the observers.
    """

    measurement_std: float
    acceleration_std: float
    correlation_time: float | None = None
    motion_std: float = 10.0
    motion_time: float = 0.1
    damping: float = 0.5**0.5


class Trial(NamedTuple):
    """Part of a log on which the filters that know no model are tuned: stamps (T,) [s], positions (T, n), which go on
    over a full turn and may lack entries (NaN), and velocities (T, n) to compare with."""

    t: Float[np.ndarray, "T"]
    y: Float[np.ndarray, "T n"]
    v: Float[np.ndarray, "T n"]
