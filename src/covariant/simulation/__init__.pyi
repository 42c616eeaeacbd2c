from ._backstepping import Backstepping as Backstepping
from ._contacts import simulate_contacts as simulate_contacts
from ._group_tracking import GroupTracking as GroupTracking
from ._piecewise import (
    PiecewiseInputs as PiecewiseInputs,
    logged_inputs as logged_inputs,
    simulate_piecewise as simulate_piecewise,
)
from ._reference import follow as follow, lissajous as lissajous
from ._sensors import PositionSensor as PositionSensor, sense as sense, stamps as stamps
from ._simulate import hold as hold, observe as observe, simulate as simulate

__all__ = ["Backstepping", "GroupTracking", "PositionSensor", "follow", "observe", "sense", "simulate", "stamps"]
