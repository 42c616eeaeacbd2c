"""The same trajectories through python-control as through the library's own simulation."""

import numpy as np
import pytest

from covariant import codegen, models
from covariant.models import state_space


@pytest.fixture(scope="module")
def control():
    return pytest.importorskip("control", reason="python-control is an optional package")


def test_a_mechanical_system_is_a_plant(control):
    """Its parameters are a dictionary, which has no hash."""
    plant = codegen.plant(state_space(models.ball_and_beam()))
    rate = plant.dynamics(0.0, np.array([0.5, 0.2, 0.1, -0.3]), np.array([0.7]))
    # r'' = r θ'² − g sin θ and (1 + r²) θ'' = u − 2 r r' θ' − g r cos θ, with unit numbers.
    expected = [0.1, -0.3, 0.5 * 0.09 - np.sin(0.2), (0.7 + 2 * 0.5 * 0.1 * 0.3 - 0.5 * np.cos(0.2)) / 1.25]
    np.testing.assert_allclose(rate, expected, rtol=1e-12)
