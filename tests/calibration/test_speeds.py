"""How fast a machine moves, from logs in which some of the measurements are wrong."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.calibration import usual_speeds
from covariant.geometry.lie import SO3
from covariant.models import GroupSystem, pendulum_chain
from covariant.signals import Record

T = np.arange(0, 4, 0.01)
RNG = np.random.default_rng(2)


def record(y):
    return Record(T, np.zeros((len(T), 2)), y)


def test_outliers_turns_and_missing_cells_change_little():
    """A steady turn and a swing; one cell in fifty off by half a radian, one in ten missing."""
    y = np.stack([3.0 * T, 0.5 * np.sin(4 * T)], axis=1)
    clean = usual_speeds(pendulum_chain(), record(y))
    assert clean == pytest.approx((3.0, 2.0), rel=0.01)
    spoiled = (y + np.pi) % (2 * np.pi) - np.pi + 0.5 * (RNG.random(y.shape) < 0.02)
    spoiled[RNG.random(y.shape) < 0.1] = np.nan
    assert usual_speeds(pendulum_chain(), record(spoiled)) == pytest.approx(clean, rel=0.1)


def test_a_log_that_mostly_stands_still_has_the_speed_of_its_motion():
    y = np.stack([np.clip(T - 3.8, 0, None) * 5.0, 0 * T], axis=1)
    assert usual_speeds(pendulum_chain(), record(y)) == pytest.approx((5.0, 0.0), rel=0.01)


@pytest.mark.long
def test_a_body_turns_by_its_own_axes():
    g = np.stack([np.asarray(SO3.exp(jnp.array([0.0, 0.0, 2.0 * t]))) for t in T[:20]])
    g[7] = np.nan
    found = usual_speeds(GroupSystem(SO3, jnp.eye(3)), Record(T[:20], np.zeros((20, 3)), g))
    assert found == pytest.approx((0.0, 0.0, 2.0), abs=1e-9)
    assert usual_speeds(GroupSystem(SO3, jnp.eye(3)), Record(T[:4], np.zeros((4, 3)), g[:4])) == (0.0,) * 3
