"""How fast a machine moves, from logs in which some of the measurements are wrong: what takes long."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_speeds import T

from covariant.calibration import usual_speeds
from covariant.geometry.lie import SO3
from covariant.models import GroupSystem
from covariant.signals import Record


def test_a_body_turns_by_its_own_axes():
    g = np.stack([np.asarray(SO3.exp(jnp.array([0.0, 0.0, 2.0 * t]))) for t in T[:20]])
    g[7] = np.nan
    found = usual_speeds(GroupSystem(SO3, jnp.eye(3)), Record(T[:20], np.zeros((20, 3)), g))
    assert found == pytest.approx((0.0, 0.0, 2.0), abs=1e-9)
    assert usual_speeds(GroupSystem(SO3, jnp.eye(3)), Record(T[:4], np.zeros((4, 3)), g[:4])) == (0.0,) * 3
