"""What is simulated: a motion and its sensors, checked before a model is loaded."""

import math
from typing import NamedTuple

import numpy as np

from covariant.simulation import PositionSensor, stamps
from covariant.verbs.base.arguments import Amounts, amounts, finite
from scalargraph.errors import InputError

FORCE = "external_force"
"""Name of an external force in a log, followed by the number of its component, as filters call their estimates."""


class Scenario(NamedTuple):
    """Motion and sensors of a simulation.

    Attributes:
        duration: Length of the log [s].
        rate: Samples a second [Hz].
        q0: Initial positions (n,), or the initial state of a state-space model; zeros by default.
        v0: Initial velocities (n,); zeros by default.
        amplitude: Amplitudes (m,) of the sinusoidal inputs; zeros by default.
        frequency: Frequency of the first input [Hz].
        noise: Standard deviation of the noise of positions [unit, SI], one or one each.
        quantum: Step of the encoders [unit, SI], one or one each.
        jitter: Standard deviation of the sampling instants [s].
        dropout: Probability that a sample is missing.
        seed: Seed of noise, jitter and dropouts.
        push: Largest force (n,) of the pushes on each coordinate [N or N m]; None for none.
    """

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
    push: Amounts | None = None

    @property
    def asks_for_motion(self) -> bool:
        """Whether an initial state, inputs or pushes are given."""
        return any(given is not None for given in (self.q0, self.v0, self.amplitude, self.push))


def check_scenario(scenario: Scenario) -> None:
    """Check what makes no sense for any model, before one is loaded."""
    PositionSensor(scenario.rate, 0.0, 0.0, scenario.jitter, scenario.dropout).check()
    if not math.isfinite(scenario.frequency) or scenario.frequency < 0:
        raise InputError(f"frequency must be a finite number ≥ 0 [Hz]; got {scenario.frequency}")
    if scenario.seed < 0:
        raise InputError(f"seed must be a whole number ≥ 0; got {scenario.seed}")
    for name in ("noise", "quantum"):
        amounts(name, getattr(scenario, name), ("",) * np.size(getattr(scenario, name)))
    for name in ("q0", "v0", "amplitude", "push"):
        finite(name, getattr(scenario, name))
    stamps(PositionSensor(scenario.rate), scenario.duration)
