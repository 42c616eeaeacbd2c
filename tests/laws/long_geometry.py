"""What takes long of `test_geometry.py`."""

import numpy as np
import pytest
from test_geometry import GEODESIC, length


@pytest.mark.exhaustive("numeric sphere", "oscillator in r", "double pendulum")
def test_triangle_inequality(space):
    r = np.roll(space.q, 1, axis=0)
    detour = length(space, space.p, r) + length(space, r, space.q)
    assert (length(space, space.p, space.q) <= detour + GEODESIC).all()
