"""What measurement noise and unmodelled forces do, simulated, against what is claimed about it: what takes long."""

import numpy as np
import pytest
from systems import ALPHA, BETA, Q, attempt
from test_noise import USUAL, sprung, worst_linear


@pytest.mark.parametrize(("stiffness", "noise", "unknown"), [(0.0, 1e-3, 0.0), (400.0, 1e-3, 0.0), (30.0, 1e-3, 0.5)])
def test_certified_steady_errors_hold_for_the_worst_signals(stiffness, noise, unknown):
    found = attempt(sprung(stiffness), **USUAL, noise=noise, disturbance=unknown)
    assert found is not None
    assert found.statement.verdict == "holds"
    assert 0 < found.steady < found.radius
    inverse = np.linalg.inv(Q)
    claimed = [found.steady * np.sqrt(2 * inverse[i, i]) for i in range(2)]
    worst = worst_linear(ALPHA, BETA, stiffness, noise, 0.5, unknown)
    assert worst[0] <= claimed[0]
    assert worst[1] <= claimed[1]
