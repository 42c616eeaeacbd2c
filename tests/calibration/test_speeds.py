"""How fast a machine moves, from logs in which some of the measurements are wrong."""

import numpy as np
import pytest

from covariant.calibration import usual_speeds
from covariant.models import pendulum_chain
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
