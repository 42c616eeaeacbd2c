"""A machine with servos, told positions: what is estimated from its log, and the C that takes its commands."""

import functools

import pytest
import servo_machine

from covariant import models
from covariant.certificates.base import need_steady_friction


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("servos") / "arm.toml"
    path.write_text(servo_machine.TEXT)
    return path


@functools.cache
def arm():
    """The model of the machine, without a file."""
    servos = {
        "shoulder": {"stiffness": 40.0, "damping": 1.0, "dead_band": 0.01, "limit": 6.0, "back_emf": 0.5}
        | {"viscous": 0.2, "coulomb": 0.3, "armature": 0.03, "switch": True},
        "elbow": {"stiffness": 20.0, "damping": 0.4, "dead_band": 0.01, "limit": 3.0, "back_emf": 0.2}
        | {"viscous": 0.1, "coulomb": 0.15, "armature": 0.02},
    }
    return models.robots.load("double_pendulum", servos=servos)


def test_a_proof_names_what_it_does_not_cover():
    with pytest.raises(ValueError, match=r"depends on cmd_shoulder, cmd_elbow, on_shoulder; .* leave these out of"):
        need_steady_friction(arm())
