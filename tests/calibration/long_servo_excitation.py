"""Commands of a servo that show its numbers: within limits in MuJoCo, and as good as they say."""

import mujoco
import numpy as np
import pytest

import covariant
from covariant import models
from covariant.calibration.identification._servo_excitation import _Simulation

ARM = """<robot name="arm"><link name="base"/>
  <link name="beam"><inertial><origin xyz="0 0 -0.12"/><mass value="0.3"/>
    <inertia ixx="0.001" iyy="0.001" izz="0.001"/></inertial></link>
  <joint name="lift" type="revolute"><parent link="base"/><child link="beam"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.2" effort="2.5" velocity="5"/></joint>
</robot>"""
MODEL = """system = "robot"
[parameters]
path = "arm.urdf"
[measurement]
std = 0.0006
[servo.lift]
stiffness = 9.0
damping = 0.5
delay = 0.043
offset = 0.02
limit = 1.8
coulomb = 0.06
armature = 0.02
dead_band = 0.004
"""
ASKED = "servo.stiffness,servo.damping,servo.delay,servo.offset,servo.coulomb,servo.dead_band,servo.armature"
PLAN = {"duration": 15.0, "rate": 50.0, "harmonics": 3, "starts": 1}
TRIALS = 20
pytestmark = pytest.mark.long  # each design searches a motion and simulates its log


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("commands")
    (folder / "arm.urdf").write_text(ARM)
    (folder / "arm.toml").write_text(MODEL)
    return folder / "arm.toml"


@pytest.fixture(scope="module")
def found(model):
    return covariant.design_excitation(model, ASKED, **PLAN)


@pytest.mark.exhaustive
def test_every_number_that_is_asked_is_shown_better_than_by_a_sine(found):
    assert list(found.columns) == ["t", "lift", "v1", "torque_lift", "cmd_lift"]
    assert found.units["torque_lift"], found.units["cmd_lift"] == ("N m", "rad")
    assert not found.warnings
    values = np.array([row["value"] for row in found.details["parameters"]])
    assert np.all(found.standard_errors < 0.03 * values)
    assert np.exp(np.mean(np.log(found.standard_errors / found.reference_errors))) < 0.8
    assert "10 s of it are a motion, 5 s slow reversals and steps" in str(found)


def test_mujoco_does_the_motion_within_the_limits(model, found, tmp_path):
    """The servo stays off its limit, and the arm within positions and speeds of its file."""
    covariant.export(model, tmp_path / "arm.xml", rate=1000.0, overrides={"servo.lift.dead_band": 0.0})
    arm = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    data, commands = mujoco.MjData(arm), found.si_columns["cmd_lift"]
    data.qpos[:] = found.si_columns["lift"][0]
    mujoco.mj_initCtrlHistory(arm, data, 0, None, np.full(arm.actuator_history[0, 0], commands[0]))
    rows = []
    for command in commands:
        rows.append((data.qpos[0], data.qvel[0], data.actuator_force[0]))
        data.ctrl[:] = command
        mujoco.mj_step(arm, data, 20)
    q, v, torque = np.array(rows).T
    # The dead band is the model's alone, and is at most its width.
    assert np.abs(q - found.si_columns["lift"]).max() < 0.012
    assert q.min() > -1.5
    assert q.max() < 1.2
    assert np.ptp(q) > 1.0
    assert np.abs(v).max() < 5
    assert np.abs(torque).max() < 1.8
    assert np.all((commands > -1.5) & (commands < 1.2))


@pytest.mark.exhaustive
def test_fits_of_noisy_logs_scatter_as_expected(model, found):
    """Gauss–Newton from the true numbers: one step, with the noise of the encoder."""
    family = models.robot_family(str(model), ASKED.split(","))
    inputs = found.si_columns["cmd_lift"][:, None]
    rows = _Simulation.of(family, 50.0).derivatives(inputs)[15:, 0]
    scale = np.linalg.norm(rows, axis=0)
    noise = 6e-4 * np.random.default_rng(0).normal(size=(len(rows), TRIALS))
    errors = np.linalg.lstsq(rows / scale, noise)[0] / scale[:, None]
    ratio = np.sqrt(np.mean(errors**2, axis=1)) / found.standard_errors
    assert np.all((ratio > 0.6) & (ratio < 1.5)), ratio


@pytest.mark.exhaustive
def test_derivatives_of_the_simulation_are_those_of_finite_differences(model, found):
    family = models.robot_family(str(model), ["servo.delay", "servo.stiffness"])
    simulation = _Simulation.of(family, 50.0)
    inputs = found.si_columns["cmd_lift"][:, None]
    slopes, start = simulation.derivatives(inputs)[:, 0], simulation.run(inputs)[0][0]
    for column, (name, step) in enumerate((("delay", 1e-5), ("stiffness", 1e-4))):
        moved = []
        for sign in (1, -1):
            value = {"delay": 0.043, "stiffness": 9.0}[name] + sign * step
            other = models.robot_family(str(model), ["servo.delay"], {f"servo.lift.{name}": value})
            changed = _Simulation.of(other, 50.0)
            moved.append(np.asarray(changed.positions_at(changed.flat, inputs, start)[0])[:, 0])
        difference = (moved[0] - moved[1]) / (2 * step)
        assert np.abs(difference - slopes[:, column]).max() < 0.02 * np.abs(difference).max()


@pytest.mark.exhaustive
def test_a_limit_that_is_asked_for_is_reached(model):
    result = covariant.design_excitation(model, f"{ASKED},servo.limit", **PLAN)
    row = next(row for row in result.details["parameters"] if row["name"] == "servo.lift.limit")
    assert row["error"] is not None
    assert row["error"] < 0.02
    assert result.details["joints"][0]["torque"]["largest"] == pytest.approx(1.8)


@pytest.mark.exhaustive
def test_what_no_log_shows_alone_is_named_and_torque_noise_is_refused(model):
    result = covariant.design_excitation(
        model, "servo.damping,servo.viscous", overrides={"servo.lift.viscous": 0.1}, **PLAN
    )
    assert any("servo.lift.damping + servo.lift.viscous" in line for line in result.warnings)
    with pytest.raises(ValueError, match="log no torque; leave out `torque_noise`"):
        covariant.design_excitation(model, "servo.damping", torque_noise=0.1, **PLAN)
