"""Robots written as URDF, MJCF and tables of actuators: each is read again, and moves in MuJoCo as here."""

import json

import mujoco
import numpy as np
import pytest

import covariant
from covariant.models import robots

STEP = 1e-3
CHAIN = """<robot name="chain">
  <link name="hub"/><link name="tool"/>
  <link name="base"><inertial><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.1 0.02 0"/><mass value="0.5"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.015" ixy="0.001" ixz="0" iyz="0"/></inertial></link>
  <link name="thumb"><inertial><mass value="0.2"/><inertia ixx="0.001" iyy="0.001" izz="0.001"/></inertial></link>
  <link name="finger"><inertial><mass value="0.1"/><inertia ixx="0.001" iyy="0.001" izz="0.001"/></inertial></link>
  <joint name="pan" type="revolute"><parent link="base"/><child link="hub"/><origin xyz="0 0 0.3" rpy="0.1 0.2 0.3"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="1" effort="3" velocity="4"/></joint>
  <joint name="tilt" type="continuous"><parent link="hub"/><child link="arm"/><origin xyz="0.05 0.1 0" rpy="1 0 0.5"/>
    <axis xyz="0 1 0"/><dynamics damping="0.1" friction="0.2"/></joint>
  <joint name="slide" type="prismatic"><parent link="arm"/><child link="finger"/><origin xyz="0.2 0 0" rpy="0 0.4 0"/>
    <axis xyz="1 0 0"/><limit lower="-0.1" upper="0.2" effort="5" velocity="1"/></joint>
  <joint name="grip" type="revolute"><parent link="finger"/><child link="thumb"/><origin xyz="0 0.1 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="3" velocity="4"/>
    <mimic joint="slide" multiplier="-0.5" offset="0.1"/></joint>
  <joint name="mount" type="fixed"><parent link="finger"/><child link="tool"/><origin xyz="0 0 0.1"/></joint>
</robot>
"""


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    path = tmp_path_factory.mktemp("chain") / "chain.urdf"
    path.write_text(CHAIN)
    return str(path)


def written(folder, suffix, path, **numbers):
    file = folder / f"robot{suffix}"
    file.write_text(robots.robot_text(suffix, path, STEP, **numbers).text)
    return file


def test_dry_friction_holds_a_load_in_mujoco(tmp_path):
    friction = {"shoulder": {"coulomb": 3.0}, "elbow": {"coulomb": 3.0}}
    path = written(tmp_path, ".xml", "double_pendulum", friction=friction)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3
    for _ in range(2000):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - 0.3).max() < 1e-3


MODEL = """system = "robot"
[parameters]
path = "double_pendulum"
[servo.shoulder]
stiffness = 9.0
damping = 0.4
delay = 0.033
feedforward = 0.009
offset = 0.1
limit = 5.0
coulomb = 0.2
stribeck = 0.1
viscous = 0.05
armature = 0.03
dead_band = 0.01
[servo.elbow]
stiffness = 4.0
"""


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text(MODEL)
    return path


def test_the_table_has_the_arguments_of_a_delayed_actuator_for_each_joint(model, tmp_path):
    result = covariant.export(model, tmp_path / "arm.json", rate=200.0)
    table = json.loads(result.out.read_text())
    # A lead of 1 ms is left out of the delay.
    assert table["actuators"]["shoulder"] == {
        "stiffness": 9.0,
        "damping": 0.4,
        "effort_limit": 5.0,
        "velocity_limit": 30.0,
        "armature": 0.03,
        "friction": pytest.approx(0.3),
        "dynamic_friction": 0.2,
        "viscous_friction": 0.05,
        "min_delay": 6,
        "max_delay": 7,
    }
    assert (table["actuators"]["elbow"]["min_delay"], table["actuators"]["elbow"]["max_delay"]) == (0, 0)
    assert table["command_offsets"] == {"shoulder": 0.1, "elbow": 0.0}
    assert table["step"] == pytest.approx(0.005)
    assert table["left_out"] == ["shoulder: dead_band = 0.01, stribeck_velocity = 0.1"]
    assert result.warnings == tuple(f"table of actuators has no entry for {line}" for line in table["left_out"])


def test_what_a_format_cannot_say_is_in_its_head(model, tmp_path):
    for suffix, line in (
        (".xml", "shoulder: dead_band = 0.01, stribeck = 0.1, stribeck_velocity = 0.1"),
        (".urdf", "shoulder: stiffness = 9, damping = 0.4, feedforward = 0.009, delay = 0.033, offset = 0.1"),
    ):
        head = covariant.export(model, tmp_path / f"arm{suffix}", rate=500.0).out.read_text().partition("-->")[0]
        assert line in head
        assert "from arm.toml" in head


def test_a_robot_without_servos_has_motors(tmp_path):
    model = mujoco.MjModel.from_xml_path(str(written(tmp_path, ".xml", "scara", actuated=["elbow", "lift"])))
    assert model.nu == 2
    assert [model.joint(int(k)).name for k in model.actuator_trnid[:, 0]] == ["elbow", "lift"]


REFUSED = {
    "joint 'tilt' is planar, and MJCF has no such joint; lock it": ('type="continuous"', 'type="planar"'),
    "MuJoCo cannot read it as MJCF": ('<mass value="0.1"/><inertia ixx="0.001"', '<mass value="0.1"/><inertia ixx="9"'),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_mjcf_does_not_have_gives_one_line(words, tmp_path):
    path = tmp_path / "chain.urdf"
    path.write_text(CHAIN.replace(*REFUSED[words]))
    with pytest.raises(ValueError, match=words) as caught:
        robots.robot_text(".xml", path, STEP)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))


def test_options_of_observers_and_models_that_are_no_robots_are_refused(model, tmp_path):
    out = tmp_path / "arm.xml"
    with pytest.raises(ValueError, match=r"alpha is for an observer, and .*arm.xml is the file of a robot"):
        covariant.export(model, out, rate=500.0, alpha=3.0)
    with pytest.raises(ValueError, match="oscillator: only a robot is written as MJCF"):
        covariant.export("oscillator", out, rate=500.0)
    covariant.export(model, out, rate=500.0)
    with pytest.raises(ValueError, match="there is such a file already"):
        covariant.export(model, out, rate=500.0)
    covariant.export(model, out, rate=500.0, overwrite=True)
    read = out.read_bytes()
    with pytest.raises(ValueError, match="a URDF file begins with <robot>"):
        covariant.export(out, tmp_path / "arm.urdf", rate=500.0)
    assert out.read_bytes() == read
