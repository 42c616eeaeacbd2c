"""Numbers of a robot that replace those of its file, against MuJoCo and closed forms; and as a family."""

import numpy as np
import pytest

from covariant import models
from covariant.models import ModelError, robots

HEAVY = (0.7, 0.02, -0.01, -0.15, 0.006, 0.007, 0.002, 3e-4, -2e-4, 1e-4)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"friction": {"wrist": {}}}, "unknown joint of friction 'wrist'. Known: shoulder, elbow"),
        (
            {"friction": {"elbow": {"dry": 1.0}}},
            "unknown number of friction of 'elbow', 'dry'. Known: viscous, coulomb",
        ),
        ({"friction": {"elbow": {"coulomb": -1.0}}}, "friction of 'elbow': coulomb must be ≥ 0; got -1.0"),
        ({"armature": {"elbow": -1.0}}, "armature of 'elbow' must be ≥ 0; got -1.0"),
        ({"torque_constants": {"elbow": 0.0}}, "torque_constants of 'elbow' must be positive; got 0.0"),
        ({"offsets": {"elbow": np.nan}}, "offsets of 'elbow' must be finite; got nan"),
        ({"inertia": {"hand": HEAVY}}, "unknown link of inertia 'hand'. Known: base, upper, lower"),
        ({"inertia": {"lower": HEAVY[:4]}}, "inertia of 'lower': give mass, cx, cy, cz, ixx"),
        ({"gravity": [1.0, 2.0]}, "gravity must be its magnitude or three numbers"),
    ],
)
def test_numbers_that_make_no_sense_are_named(numbers, message):
    with pytest.raises(ValueError, match=message):
        robots.load("double_pendulum", **numbers)


@pytest.mark.core(3)
@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["frction"], "unknown group of numbers 'frction'. Did you mean 'friction'"),
        (["friction.elbw"], "unknown joint in friction 'elbw'. Did you mean 'elbow'"),
        (["armature.3"], "unknown joint in armature '3'"),
        (["friction.elbow.dry"], "friction.elbow has no 'dry'; there are viscous, coulomb, asymmetry"),
        (["inertia.base"], "inertia.base: it has no mass, or does not move; there are upper, lower"),
        (["friction.2", "friction.elbow.coulomb"], "friction.elbow.coulomb is named twice"),
        (["inertia.lower.mass"], "inertia.lower: its ten numbers are fitted together; drop 'mass'"),
        ([], "no number is named; name some of friction, armature, payload"),
    ],
)
def test_names_of_a_robot_that_do_not_exist_are_told_in_one_line(names, message):
    with pytest.raises(ModelError, match=message):
        models.robot_family("double_pendulum", names)
