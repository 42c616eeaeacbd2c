"""Momentum observer: on exact motions its force is the true one behind a first-order lag."""

import numpy as np
import pytest

from covariant import models
from covariant.observers import MomentumObserver, observed_forces
from covariant.signals import StampError

CHAIN = models.pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.05, 0.02))


def test_rows_without_a_motion_leave_the_force_as_it_was():
    """Also the row after, if it has nothing to start from; after that the force is found again."""
    t = np.linspace(0.0, 2.0, 201)  # a unit mass on a unit spring, pushed by 2 N
    q, v, u = 2 * (1 - np.cos(t))[:, None], 2 * np.sin(t)[:, None], np.zeros((201, 1))
    observer = MomentumObserver(models.oscillator(), 25.0)
    whole = np.asarray(observed_forces(observer, t, u, q, v))
    for spoiled in range(3):
        rows = u.copy(), q.copy(), v.copy()
        rows[spoiled][100] = np.nan
        force = np.asarray(observed_forces(observer, t, *rows))
        held = 101 if spoiled == 0 else 100  # the input of a row acts until the next one
        assert force[held] == force[held - 1]
        np.testing.assert_array_equal(force[:100], whole[:100])
        np.testing.assert_allclose(force[180:], whole[180:], atol=1e-4)


def test_a_sample_with_the_stamp_of_the_one_before_changes_nothing():
    t = np.linspace(0.0, 2.0, 201)
    rows = np.zeros((201, 1)), 2 * (1 - np.cos(t))[:, None], 2 * np.sin(t)[:, None]
    observer = MomentumObserver(models.oscillator(), 25.0)
    twice = [
        np.insert(each, 100, each[99] + shift, axis=0) for each, shift in zip((t, *rows), (0, 0, 1, 1), strict=True)
    ]
    force = np.delete(np.asarray(observed_forces(observer, *twice)), 100, axis=0)
    np.testing.assert_array_equal(force, observed_forces(observer, t, *rows))


def test_stamps_that_say_nothing_are_named():
    observer, zeros = MomentumObserver(CHAIN, 1.0), np.zeros((3, 2))
    with pytest.raises(StampError, match=r"row 3: the stamp 0\.05 s is not finite or before that of row 2"):
        observed_forces(observer, np.array([0.0, 0.1, 0.05]), zeros, zeros, zeros)
    with pytest.raises(StampError, match="row 2: the stamp nan s"):
        observed_forces(observer, np.array([0.0, np.nan, 0.1]), zeros, zeros, zeros)
    with pytest.raises(ValueError, match="at least one"):
        observed_forces(observer, np.zeros(0), *[np.zeros((0, 2))] * 3)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="MomentumObserver: gain"):
        MomentumObserver(CHAIN, 0.0)
    with pytest.raises(ValueError, match=r"same number of rows.*'v': 2"):
        observed_forces(MomentumObserver(CHAIN, 1.0), np.zeros(3), np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((2, 2)))
