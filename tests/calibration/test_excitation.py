"""Motions that determine numbers of a robot: limits, rest, gradients, and the errors that logs of them really give."""

import numpy as np
import pytest
from two_links import Truth

from covariant import models
from covariant.calibration import ExcitationPlan, JointLimits, Sensing, design_excitation
from covariant.calibration.identification import FourierMotion
from covariant.calibration.identification._fourier import resting_basis

TRUTH = Truth((0.05, 0.02), (0.1, 0.05), (0.02, -0.01), armature=(0.01, 0.004))
JOINTS = ("shoulder", "elbow")
KNOWN = {
    "parameters.friction": {
        name: {kind: getattr(TRUTH, kind)[j] for kind in ("viscous", "coulomb", "asymmetry")}
        for j, name in enumerate(JOINTS)
    },
    "parameters.armature": dict(zip(JOINTS, TRUTH.armature, strict=True)),
}
HALF = 0.03
LIMITS = JointLimits(JOINTS, np.array([-1.0, -1.5]), np.array([1.2, 1.5]), np.array([4.0, 5.0]), np.array([2.5, 1.0]))
SENSING = Sensing(np.array([1e-4, 2e-4]), np.array([0.02, 0.01]), 250.0)
PLAN = ExcitationPlan(duration=10.0, frequency=0.2, harmonics=3, starts=1)


def family(*names: str, **overrides: object) -> models.RobotFamily:
    return models.robot_family("double_pendulum", names, KNOWN | overrides)


@pytest.fixture(scope="module")
def robot() -> models.RobotFamily:
    return family("friction", "armature")


def test_a_fourier_motion_has_the_derivatives_that_it_says():
    rng = np.random.default_rng(0)
    motion = FourierMotion(0.3, rng.normal(size=2), resting_basis(4) @ rng.normal(size=(6, 2)))
    t, h = rng.uniform(0, 10, 50), 1e-5
    (before, slower, _), (_, v, a), (after, faster, _) = (motion.at(t + shift) for shift in (-h, 0.0, h))
    np.testing.assert_allclose(v, (after - before) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(a, (faster - slower) / (2 * h), atol=1e-6)
    ends = np.array([0.0, 1 / 0.3])
    _, v, a = motion.at(ends)
    np.testing.assert_allclose([v, a], 0, atol=1e-10)
    assert resting_basis(4).shape == (8, 6)


def test_a_joint_without_a_motor_is_refused():
    robot = family("friction", **{"parameters.actuated": ["shoulder"]})
    with pytest.raises(ValueError, match="no motor moves joint 'elbow'"):
        design_excitation(robot, LIMITS, SENSING, PLAN, HALF)
