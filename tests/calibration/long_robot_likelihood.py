"""A robot fitted by the likelihood of all rows: what short logs tell, beside residual torques of the same rows."""

import jax.numpy as jnp
import numpy as np
import pytest
from two_links import Truth, swing

import covariant
from covariant import models, scoring
from covariant.calibration import fit_robot
from covariant.calibration.identification import Unknowns, error_model, gather, likeliest_robot, linearised_robot
from covariant.calibration.identification._robot_likelihood import RobotUnknowns
from covariant.signals import Record

TRUTH = Truth(coulomb=(0.0, 0.0), asymmetry=(0.0, 0.0))
NAMES = ["friction.viscous", "armature"]
TRUE = np.array([*TRUTH.viscous, *TRUTH.armature])
HALF = 0.03


@pytest.fixture(scope="module")
def short():
    """A log of 2.5 s of an arm without dry friction, whose encoders alone are noisy, and its rows."""
    family = models.robot_family("double_pendulum", NAMES, {"parameters.friction": free()})
    t, u, y = swing(1, TRUTH, 2.5, 250.0, torque_noise=0.0)
    record = Record(t, u[0], y[0])
    rows = gather(family.file.model.manifold, [record], [scoring.zero_phase_velocity(t, y[0], t, HALF)])
    return family, record, rows


def free() -> dict[str, dict[str, float]]:
    return {joint: {"viscous": 0.1, "coulomb": 0.0} for joint in ("shoulder", "elbow")}


def test_all_rows_tell_many_times_more_than_residual_torques(short):
    family, record, rows = short
    by_torques = fit_robot(family, [record], HALF)
    found = likeliest_robot(RobotUnknowns.of(family, rows), by_torques, rows)
    assert found.determined.all()
    assert (np.abs(found.values - TRUE) < 4 * found.standard_errors).all()
    assert (found.standard_errors < by_torques.standard_errors / 4).all()


def test_derivatives_in_the_numbers_are_those_of_a_step_of_the_model(short):
    """Beside forward differentiation of the step itself."""
    family, _, rows = short
    unknowns = RobotUnknowns.of(family, rows)
    z = np.array([0.3, -0.2, 0.1, 0.2]) * 0.01
    here = rows._replace(start=rows.start)
    ours = linearised_robot(unknowns, jnp.asarray(z), rows.start, here, 1)

    def make(values):
        return family.make(values), 0.0

    plain = Unknowns(make, jnp.ones(4), (False,) * 4, family.parts, family.file.model.manifold)
    # Of values 1 + sinh(z − 1), as z = 1 + arcsinh(x − 1), the slopes are in units.
    x = z * unknowns.sizes
    expected = error_model(plain, jnp.arcsinh(jnp.asarray(x) - 1.0), rows.start, here, 1)
    at = np.asarray(expected.slopes) / np.sqrt(1 + (x - 1.0) ** 2) * unknowns.sizes
    moving = (np.abs(np.asarray(rows.start.v)) > unknowns.sticking).all(axis=1)
    both = moving[1:-1] & moving[2:]
    scale = np.abs(at).max(axis=(0, 1))
    np.testing.assert_allclose((np.asarray(ours.slopes)[1:-1] / scale)[both], (at[1:-1] / scale)[both], atol=0.06)
    np.testing.assert_allclose(ours.defect, expected.defect, atol=1e-4)
    np.testing.assert_allclose(ours.transition, expected.transition, atol=5e-3)


@pytest.mark.exhaustive
def test_a_log_that_is_too_short_for_residual_torques_of_many_windows_is_fitted():
    t, u, y = swing(1, TRUTH, 1.5, 250.0, torque_noise=0.0)
    result = covariant.fit("double_pendulum", Record(t, u[0], y[0]), NAMES, overrides={"parameters.friction": free()})
    assert result.better
    assert (np.abs(result.values - TRUE) < 4 * result.standard_errors).all()
