"""Transmissions of URDF: a rotor behind a gear is felt as n² J, and only where the file states one."""

import jax.numpy as jnp
import numpy as np
import pytest

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


def test_the_inertia_matrix_has_it_on_the_diagonal(read):
    geared, plain = (robots.assemble(read(text), lock={"tip": 0.0}) for text in (PLAIN + ROTOR, PLAIN))
    q = jnp.array([0.3, -0.7])
    np.testing.assert_allclose(geared.space(q) - plain.space(q), np.diag([0.0, 0.2]), atol=1e-14)


WRONG = {
    "joint 'tip' is ball, and a rotor needs one axis": ('name="hand"/>', 'name="tip"/>'),
    "there is no joint 'leg'": ('name="hand"/>', 'name="leg"/>'),
    "1 rotors on 2 joints are not supported": ('<joint name="hand"/>', '<joint name="hand"/><joint name="arm"/>'),
    "rotor_inertia must not be negative; got -2e-05 kg m²": ('"2e-5"', '"-2e-5"'),
    "gear_ratio must not be 0": ('"100"', '"0"'),
    "gear_ratio 100 and mechanicalReduction 50 differ": (
        "<limit/>",
        "<mechanicalReduction>50</mechanicalReduction>",
    ),
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
