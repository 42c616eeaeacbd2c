"""Transmissions of URDF: a rotor behind a gear is felt as n² J, and only where the file states one."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.models import robots

INERTIA = '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.025"/>'
LINK = f'<inertial><origin xyz="0.1 0.05 -0.2"/><mass value="2"/>{INERTIA}</inertial>'
JOINTS = "".join(
    f'<link name="{name}">{LINK}</link><joint name="{name}" type="{kind}"><parent link="{parent}"/>'
    f'<child link="{name}"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/></joint>'
    for name, kind, parent in (("arm", "continuous", "base"), ("hand", "continuous", "arm"), ("tip", "ball", "hand"))
)
PLAIN = """<transmission name="t"><type>transmission_interface/SimpleTransmission</type><joint name="arm"/>
<actuator name="m"><mechanicalReduction>-50</mechanicalReduction></actuator></transmission>"""
ROTOR = """<transmission name="r"><type>transmission_interface/SimpleTransmission</type><joint name="hand"/>
<actuator name="m"><drake:rotor_inertia value="2e-5"/><drake:gear_ratio value="100"/><limit/>
</actuator></transmission>"""


@pytest.fixture
def read(tmp_path):
    def read(transmissions: str) -> robots.Description:
        text = f'<robot name="r" xmlns:drake="http://drake.mit.edu"><link name="base"/>{JOINTS}{transmissions}</robot>'
        (tmp_path / "geared.urdf").write_text(text)
        return robots.read(tmp_path / "geared.urdf")

    return read


def test_a_rotor_behind_a_gear_is_an_inertia_of_its_joint(read):
    """A reduction alone changes nothing; both notations of the reduction; what is not needed is counted as ignored."""
    robot = read(PLAIN + ROTOR)
    assert {joint.name: joint.armature for joint in robot.joints} == {"arm": 0.0, "hand": 0.2, "tip": 0.0}
    both = read(PLAIN.replace("</actuator>", '<drake:rotor_inertia value="2e-5"/></actuator>') + ROTOR + ROTOR)
    np.testing.assert_allclose([joint.armature for joint in both.joints], [2500 * 2e-5, 0.4, 0.0], rtol=1e-12)
    assert robot.used["transmission/actuator/rotor_inertia"] == robot.used["transmission"] == 1
    assert robot.used["transmission/actuator/gear_ratio"] == 1
    assert robot.ignored["transmission/actuator/mechanicalReduction"] == robot.ignored["transmission"] == 1
    assert robot.ignored["transmission/type"] == 2
    assert robot.ignored["transmission/actuator/limit"] == 1


WRONG = {
    "joint 'tip' is ball, and a motor needs one axis": ('name="hand"/>', 'name="tip"/>'),
    "there is no joint 'leg'": ('name="hand"/>', 'name="leg"/>'),
    "1 rotors on 2 joints are not supported": ('<joint name="hand"/>', '<joint name="hand"/><joint name="arm"/>'),
    "rotor_inertia must not be negative; got -2e-05 kg m²": ('"2e-5"', '"-2e-5"'),
    "gear_ratio must not be 0": ('"100"', '"0"'),
    "gear_ratio 100 and mechanicalReduction 50 differ": ("<limit/>", "<mechanicalReduction>50</mechanicalReduction>"),
    "<mechanicalReduction> must be a finite number; got '1:50'": (
        '<drake:gear_ratio value="100"/>',
        "<mechanicalReduction>1:50</mechanicalReduction>",
    ),
}


@pytest.mark.parametrize("words", WRONG)
def test_what_no_gear_has_is_one_clear_line(words, read):
    old, new = WRONG[words]
    assert old in ROTOR
    with pytest.raises(ValueError, match=r"geared\.urdf: transmission 'r': [^\n]*$") as error:
        read(ROTOR.replace(old, new))
    assert words in str(error.value)


EACH = PLAIN + ROTOR.replace("<limit/>", "<mechanicalReduction>100</mechanicalReduction>")


@pytest.fixture
def load(read, tmp_path):
    def load(transmissions: str, **options):
        read(transmissions)
        return robots.load(tmp_path / "geared.urdf", lock={"tip": 0.0}, **options)

    return load


def test_a_joint_that_follows_adds_to_the_load_of_the_motor(read, tmp_path):
    """The motor's torque acts on the joint that leads, and needs no gear at the one that follows."""
    read(PLAIN)
    path = tmp_path / "geared.urdf"
    axis = '<axis xyz="0 1 0"/></joint>'
    first, second, *rest = path.read_text().split(axis)
    path.write_text(axis.join([first, second]) + '<axis xyz="0 1 0"/><mimic joint="arm"/></joint>' + axis.join(rest))
    model = robots.load(path, lock={"tip": 0.0}, motor_torques=True)
    assert model.coordinates == ("arm",)
    np.testing.assert_array_equal(model.force(0.0, jnp.zeros(1), jnp.array([0.02])), [-1.0])


def test_the_report_says_that_reductions_were_used(read, tmp_path):
    read(EACH)
    robot = robots.read(tmp_path / "geared.urdf", motor_torques=True)
    assert robot.used["transmission/actuator/mechanicalReduction"] == robot.used["transmission"] == 2
    assert not robot.ignored.get("transmission/actuator/mechanicalReduction")


@pytest.mark.parametrize(
    ("transmissions", "words"),
    [
        ("", "motor_torques: joint 'arm' has no reduction; give it one <transmission>"),
        (PLAIN, "motor_torques: joint 'hand' has no reduction"),
        (PLAIN + EACH, "joint 'arm' has 2 transmissions with a reduction"),
        (EACH.replace("-50", "0"), "transmission 't': mechanicalReduction must not be 0"),
        (EACH.replace('"arm"/>', '"arm"/><joint name="hand"/>'), "transmission 't': a reduction of 2 joints"),
    ],
)
def test_a_motor_without_one_gear_is_one_clear_line(transmissions, words, load):
    with pytest.raises(ValueError, match=r"geared\.urdf: [^\n]*$") as error:
        load(transmissions, motor_torques=True)
    assert words in str(error.value)


def test_motors_of_mjcf_have_their_gears_already(tmp_path):
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    with pytest.raises(ValueError, match=r"arm\.xml: motor_torques is for URDF; [^\n]*$"):
        robots.load(tmp_path / "arm.xml", motor_torques=True)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ('motor_torques="yes"', "parameter motor_torques of robot must be bool; got 'yes'"),
        ("dry_friction=1", "parameter dry_friction of robot must be bool; got 1"),
        ("lock=3", r"parameter lock of robot must be Mapping\[str, float\] \| None; got 3"),
        ("payload={hand='x'}", r"parameter payload of robot must be .*; got {'hand': 'x'}"),
    ],
)
def test_parameters_of_another_type_are_one_clear_line(override, words, read, tmp_path):
    read(EACH)
    with pytest.raises(ValueError, match=f"{words}$"):
        models.load(str(tmp_path / "geared.urdf"), (f"parameters.{override}",))
