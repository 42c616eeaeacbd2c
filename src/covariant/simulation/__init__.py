"""Simulation of models, alone or with an observer, and of sensors."""

from covariant.simulation import _simulate_state_space as _simulate_state_space  # teaches both state-space models
from covariant.simulation._sensors import Sensor, sense, stamps
from covariant.simulation._simulate import hold, no_input, observe, simulate

__all__ = ["Sensor", "hold", "no_input", "observe", "sense", "simulate", "stamps"]
