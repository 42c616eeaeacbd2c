"""What is simulated: a motion and its sensors, checked before a model is loaded."""

import math
from typing import NamedTuple

import numpy as np

from covariant.simulation import Sensor, stamps
from covariant.workflow._arguments import Amounts, amounts, finite


class Scenario(NamedTuple):
    """The motion and the sensors of a simulation, as `simulate` takes them."""

    duration: float
    rate: float
    q0: Amounts | None
    v0: Amounts | None
    amplitude: Amounts | None
    frequency: float
    noise: Amounts
    quantum: Amounts
    jitter: float
    dropout: float
    seed: int


def check_scenario(scenario: Scenario) -> None:
    """Refuse what makes no sense for any model, before one is loaded."""
    Sensor(scenario.rate, 0.0, 0.0, scenario.jitter, scenario.dropout).check()
    if not math.isfinite(scenario.frequency) or scenario.frequency < 0:
        raise ValueError(f"frequency must be a finite number ≥ 0 [Hz]; got {scenario.frequency}")
    if scenario.seed < 0:
        raise ValueError(f"seed must be a whole number ≥ 0; got {scenario.seed}")
    for name in ("noise", "quantum"):
        amounts(name, getattr(scenario, name), ("",) * np.size(getattr(scenario, name)))
    for name in ("q0", "v0", "amplitude"):
        finite(name, getattr(scenario, name))
    stamps(Sensor(scenario.rate), scenario.duration)
