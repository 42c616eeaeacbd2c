"""Numbers of a robot from logs of an arm that is simulated by its own closed form: truth, intervals, combinations."""

import re
from pathlib import Path

import numpy as np
import pytest
from two_links import Truth, swing

from covariant import models
from covariant.calibration import fit_robot
from covariant.calibration.identification._robot_fit import rounded_values
from covariant.calibration.identification._robot_torques import told_from_zero
from covariant.signals import Record

HALF = 0.03


def test_only_what_has_become_zero_isrounded_values_to_it():
    """At its bound a friction is zero but for rounding; one that the log does not show stays, whatever its prior."""
    values, first = np.array([1e-17, 1e-18, 0.05]), np.array([0.05, 0.0, 0.05])
    assert rounded_values(values, first, np.array([1.0, 1.0, 1e12])).tolist() == [0.0, 0.0, 0.05]


def test_a_log_that_is_too_short_is_refused():
    t, u, y = swing(1, Truth(), 0.4)
    with pytest.raises(ValueError, match=r"a fit needs 0.36 s; give longer logs"):
        fit_robot(models.robot_family("double_pendulum", ["friction"]), [Record(t, u[0], y[0])], HALF)


def test_positions_may_come_at_fewer_rows_than_torques():
    """Those of every second row: the numbers are those of all rows, within their standard errors."""
    t, u, y = swing(1, Truth(), 4.0)
    family = models.robot_family("double_pendulum", ["friction.viscous"])
    half = np.where(np.arange(len(t))[:, None] % 2, np.nan, y[0])
    whole, fewer = (fit_robot(family, [Record(t, u[0], each)], HALF) for each in (y[0], half))
    assert (np.abs(whole.values - fewer.values) < 3 * fewer.standard_errors).all()


def test_a_number_is_determined_where_zero_and_a_tenth_of_its_usual_size_are_told_apart():
    """A Coulomb friction of 0 ± 0.78 N m says nothing where the motor has 3 N m; one of 2.6 ± 0.78 N m does."""
    values, errors = np.array([0.0, 2.6, 0.0, 0.4]), np.array([0.78, 0.78, 0.1, 0.1])
    assert told_from_zero(values, errors, np.full(4, 3.0)).tolist() == [False, True, True, True]
    assert told_from_zero(values, errors, np.full(4, 20.0)).tolist() == [True] * 4
    assert not told_from_zero(-values, errors, np.full(4, 1.0))[2]


def test_a_joint_may_stick_by_the_friction_of_its_file(tmp_path):
    text = models.robots.located("double_pendulum").read_text()
    path, slippery = tmp_path / "arm.urdf", str(tmp_path / "slippery.urdf")
    assert 'friction="0.01"/>' in text, "of the elbow"
    Path(slippery).write_text(re.sub(' friction="[^"]*"', "", text))
    path.write_text(re.sub(' friction="0.01"', "", text, count=1))
    dry = [joint.friction > 0 for joint in models.robots.read(str(path)).joints]
    assert sum(dry) == 1
    assert models.robot_family(str(path), ["armature"]).resting == tuple(0.02 * each for each in dry)
    assert models.robot_family(slippery, ["friction.elbow"]).resting == (0.0, 0.02)
    assert models.robot_family(slippery, ["armature"]).resting == (0.0, 0.0)
    law = {"parameters.friction": {"elbow": {"coulomb": 0.1, "smoothing": 0.05}}}
    assert models.robot_family(slippery, ["armature"], law).resting == (0.0, 0.05)
