"""Noise of the torques: the filter has the noise of the acceleration that the inertia makes of it, everywhere."""

import numpy as np
import pytest

from covariant import models

TORQUES = np.array([0.3, 0.05])
FILE = {
    "parameters.mass": [1.0, 0.7],
    "parameters.length": [0.5, 0.4],
    "measurement.std": 1e-3,
    "uncertainty.acceleration": 0.1,
    "uncertainty.torque": TORQUES.tolist(),
}


@pytest.mark.parametrize("value", [[0.1], -0.1, 0.0])
def test_bad_numbers_are_refused(value):
    with pytest.raises(ValueError, match=r"uncertainty\.torque"):
        models.load("pendulum_chain", FILE | {"uncertainty.torque": value})
