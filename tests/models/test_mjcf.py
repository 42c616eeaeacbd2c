"""MJCF through MuJoCo's compiler: the same mechanics as the engine's own, or a refusal that names what is wrong."""

import mujoco
import numpy as np
import pytest

from covariant.models import robots
from covariant.models.robots._against_mujoco import refuse_difference
from covariant.models.robots._mjcf import read_mjcf

ARM = """<mujoco model="arm">
  <compiler angle="degree" autolimits="true"/>
  <option gravity="0.3 0 -9.7"/>
  <default><joint damping="0.2"/></default>
  <worldbody>
    <body name="stand" pos="0 0 0.5" euler="10 0 20"><geom type="box" size="0.1 0.1 0.1"/>
      <body name="shoulder" pos="0.1 0 0.2" euler="0 30 0">
        <joint name="turn" axis="0 0 1" pos="0.02 0.01 0" armature="0.1"/>
        <joint name="bend" axis="0 1 1" pos="0 0 0.05" range="-90 120" ref="15" stiffness="3" springref="20"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0.1" size="0.04"/>
        <body name="slider" pos="0.3 0 0.1">
          <joint name="slide" type="slide" axis="1 0 0.2" ref="0.1" range="-0.3 0.3"/>
          <geom type="sphere" size="0.06" pos="0.02 0.03 0"/>
          <body name="finger" pos="0.05 0.02 0"><joint name="finger" type="slide" axis="0 1 0"/>
            <geom type="box" size="0.02 0.01 0.03"/></body>
        </body>
        <body name="elbow" pos="-0.1 0.1 0">
          <joint name="elbow" axis="1 0 0" damping="0.5"/>
          <inertial pos="0.01 0.1 0" mass="0.9" fullinertia="0.003 0.001 0.003 0.0001 0 0.0002"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="finger" joint2="slide" polycoef="0.01 -0.5 0 0 0"/></equality>
  <actuator>
    <motor name="m1" joint="turn" gear="50"/>
    <position name="m2" joint="bend" kp="20" kv="2" gear="3"/>
    <motor name="m3" joint="elbow" gear="-4"/>
  </actuator>
</mujoco>
"""
FREE = """<mujoco model="flyer">
  <worldbody><body name="trunk" pos="0 0 1"><freejoint name="free"/><geom type="box" size="0.2 0.1 0.05"/>
    <body name="leg" pos="0.2 0 0"><joint name="hip" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/></body></body></worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mjcf")
    (folder / "arm.xml").write_text(ARM)
    return folder


@pytest.fixture(scope="module")
def arm(folder):
    return robots.load(folder / "arm.xml")


def test_a_free_joint_floats(folder):
    (folder / "free.xml").write_text(FREE)
    model = robots.load(folder / "free.xml")
    assert model.space.floating
    assert model.coordinates == ("hip",)
    assert model.manifold.shape == (17,)
    theirs = mujoco.MjModel.from_xml_string(FREE)
    assert float(model.space.mass) == pytest.approx(theirs.body_mass.sum())


def test_with_joints_named_the_motors_are_left_out(folder):
    assert robots.load(folder / "arm.xml", actuated=["elbow"]).inputs == 1
    assert robots.read(folder / "arm.xml").ignored["geom (contacts, shapes)"] == 4


WRONG = {
    "has a state of its own": ('<motor name="m1"', '<general dyntype="filter" dynprm="0.1" name="m1"'),
    "fluid": ('gravity="0.3 0 -9.7"', 'density="1.2"'),
    "gravcomp": ('<body name="elbow"', '<body gravcomp="1" name="elbow"'),
    "x.stl'; the inertia of body 'stand' follows from a mesh: give an <inertial>": (
        '<worldbody>\n    <body name="stand" pos="0 0 0.5" euler="10 0 20"><geom type="box" size="0.1 0.1 0.1"/>',
        '<asset><mesh file="x.stl"/></asset><worldbody><body name="stand"><geom type="mesh" mesh="x"/>',
    ),
    "joint 'bend': springs and dampers that are not linear": ('stiffness="3"', 'stiffness="3 1"'),
    "actuator 'm2' has a forcerange from -9 to 3, not the same in both directions": (
        'kp="20"',
        'kp="20" forcerange="-3 1"',
    ),
    "actuator 'm2' shares the actuatorfrcrange of its joint": (
        '<motor name="m1" joint="turn" gear="50"/>',
        '<motor name="m1" joint="bend"/></actuator><default><joint actuatorfrcrange="-1 1"/></default><actuator>',
    ),
    "actuator 'm1' has a delay": ('<motor name="m1"', '<motor delay="0.01" nsample="3" name="m1"'),
    "actuator 'm1': a damper that is not linear": ('<motor name="m1"', '<motor damping="1 2" name="m1"'),
    "armature and damping are supported only where it drives a hinge or a slide": (
        "<actuator>",
        '<tendon><fixed name="pull"><joint joint="turn" coef="1"/></fixed></tendon><actuator>'
        '<motor name="m4" tendon="pull" armature="0.1"/>',
    ),
    "tendon 'a': springs, damping": (
        "<equality>",
        '<tendon><fixed name="a" stiffness="0 2"><joint joint="turn" coef="1"/></fixed></tendon><equality>',
    ),
    "coupled tendons are not supported": (
        "<equality>",
        '<tendon><fixed name="a"><joint joint="turn" coef="1"/></fixed><fixed name="b"><joint joint="bend" coef="1"/>'
        '</fixed></tendon><equality><tendon tendon1="a" tendon2="b"/>',
    ),
    "document type or entities": ("<mujoco", '<!DOCTYPE mujoco [<!ENTITY a "b">]><mujoco'),
    "begins with <robot> (URDF) or <mujoco> (MJCF); found <sdf>": (ARM, "<sdf/>"),
}


@pytest.mark.parametrize("words", WRONG)
def test_what_is_not_supported_gives_one_clear_line(words, tmp_path):
    old, new = WRONG[words]
    assert old in ARM
    path = tmp_path / "broken.xml"
    path.write_text(ARM.replace(old, new))
    with pytest.raises(ValueError, match=r"broken\.xml: ") as error:
        robots.load(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_limits_in_degrees_are_doubted(tmp_path):
    path = tmp_path / "degrees.xml"
    path.write_text(ARM.replace('angle="degree" autolimits', 'angle="radian" autolimits'))
    assert "are they degrees?" in robots.read(path).doubts[0]


# What the file says of actuators, free joints, bodies and meshes; `load` compares each with MuJoCo to 1e-9


def moved(tmp_path, text, **options):
    (tmp_path / "robot.xml").write_text(text)
    return robots.load(tmp_path / "robot.xml", **options)


def inertia(model):
    return np.asarray(model.space(model.manifold.origin()))


def test_a_position_servo_has_its_limit_and_its_delay(tmp_path):
    """A gear scales the limit; the smaller one of actuator and joint counts, and a motor's own has no meaning."""
    text = ARM.replace(
        'kp="20" kv="2" gear="3"', 'kp="20" kv="2" gear="-3" delay="0.02" nsample="30" forcerange="-4 4"'
    )
    path = tmp_path / "arm.xml"
    path.write_text(text.replace('name="m1"', 'name="m1" forcerange="-1 2"'))
    motor = robots.read(path).motors[1]
    assert (motor.limit, motor.delay, motor.stiffness) == (12.0, 0.02, pytest.approx(180.0))
    assert robots.read(path).ignored["actuator/forcerange"] == 1
    servos = robots.load(path).force.servos
    assert servos.limit.tolist() == [12.0]
    assert servos.delay.tolist() == [0.0, 0.02, 0.0]
    path.write_text(text.replace('name="bend"', 'name="bend" actuatorfrcrange="-5 5"'))
    assert robots.read(path).motors[1].limit == 5.0


@pytest.mark.parametrize("entry", ["armature", "damping"])
def test_an_entry_that_is_not_read_is_refused_by_its_joint(entry, tmp_path, monkeypatch):
    """As one of a later MuJoCo would be: the reader does not look at actuators here, nor at limits of motors."""
    monkeypatch.setattr("covariant.models.robots._mjcf._with_actuators", lambda read, joints: joints)
    text = ARM.replace('gear="3"', f'gear="3" {entry}="0.0625" forcerange="-1 1" ctrlrange="-1 1"')
    with pytest.raises(ValueError, match=r"joint 'bend' does not move as in MuJoCo: .* % off\)|joint 'bend'.*%"):
        moved(tmp_path, text)


FIELDS = {
    "body_gravcomp": 0.5,
    "body_inertia": 0.01,
    "body_ipos": 0.02,
    "body_mass": 0.1,
    "body_pos": 0.01,
    "body_quat": 0.1,
    "dof_armature": 0.01,
    "dof_damping": 0.3,
    "dof_dampingpoly": 0.3,
    "jnt_axis": 0.1,
    "jnt_pos": 0.01,
    "jnt_stiffness": 0.5,
    "jnt_stiffnesspoly": 0.5,
    "qpos_spring": 0.2,
    "actuator_armature": 1e-3,
    "actuator_biasprm": -1.0,
    "actuator_damping": 1e-3,
    "actuator_dampingpoly": 1e-3,
    "actuator_gainprm": 0.3,
    "actuator_gear": 0.3,
}


@pytest.mark.parametrize("field", FIELDS)
def test_no_field_of_the_compiled_model_can_be_dropped(field, folder):
    """An entry of the joint "bend", its motor, or the body "elbow" is changed after the description was read."""
    robot, model = read_mjcf(folder / "arm.xml")
    refuse_difference(model, robot, None)
    joint = model.joint("bend")
    body, motor = model.body("elbow").id, model.actuator("m2").id
    row = {"body": body, "dof": joint.dofadr[0], "qpos": joint.qposadr[0], "jnt": joint.id, "actuator": motor}
    getattr(model, field)[row[field.split("_")[0]]] += FIELDS[field]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    with pytest.raises(ValueError, match=r"joint '.*' does not move as in MuJoCo"):
        refuse_difference(model, robot, None)


@pytest.mark.parametrize("option", ["density", "viscosity", "gravity"])
def test_no_option_that_acts_on_all_bodies_can_be_dropped(option, folder):
    robot, model = read_mjcf(folder / "arm.xml")
    setattr(model.opt, option, getattr(model.opt, option) + 0.1)
    with pytest.raises(ValueError, match="does not move as in MuJoCo"):
        refuse_difference(model, robot, None)


@pytest.mark.parametrize(
    "options", [{}, {"lock": {"bend": 0.4}}, {"actuated": ["elbow", "turn"]}, {"lock": {"slide": 0.1, "turn": 1.0}}]
)
def test_the_comparison_holds_with_locked_and_chosen_joints(options, tmp_path):
    assert moved(tmp_path, ARM, **options).inputs == {"lock": 2, "actuated": 2}.get(next(iter(options), ""), 3)
