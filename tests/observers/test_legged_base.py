"""The base of a robot on legs, on simulated trots, against an invariant filter written apart from the library."""

import pytest

import covariant
from covariant.models import robots

TWO_FEET = {"parameters.path": "quadruped", "parameters.feet": {"FL_FOOT": [0.0, 0.0, 0.0], "HR_FOOT": [0.0, 0.0, 0.0]}}


def test_what_is_no_leg_is_refused():
    space = robots.load("quadruped", floating=True).space
    with pytest.raises(ValueError, match=r"FL_SHOULDER is carried by 1 joints; a foot needs three or more"):
        robots.legs(space, {"FL_SHOULDER": [0.0, 0.0, 0.0]}, 0.0)
    with pytest.raises(ValueError, match=r"\{LINK: \[x, y, z\]\}"):
        robots.legs(space, {"FL_LOWER_LEG": [0.0, 0.0]}, 0.0)
    with pytest.raises(ValueError, match="how the legs move is no part of the model"):
        covariant.simulate("legged_base", duration=0.1, overrides=TWO_FEET)
    with pytest.raises(ValueError, match="the base must be free"):
        robots.legs(robots.load("panda").space, {"link7": [0.0, 0.0, 0.0]}, 0.0)
