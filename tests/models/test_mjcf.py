"""MJCF through MuJoCo's compiler: the same mechanics as the engine's own, or a refusal that names what is wrong."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from covariant.models import acceleration, load, robots

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
COORDINATES = ("turn", "bend", "slide", "elbow")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mjcf")
    (folder / "arm.xml").write_text(ARM)
    return folder


@pytest.fixture(scope="module")
def arm(folder):
    return robots.load(folder / "arm.xml")


@pytest.mark.exhaustive
def test_an_arm_moves_as_in_mujoco(arm):
    """Anchors beside the axes, references, springs, gears, a servo, two joints of one body, a finger that follows."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    assert arm.coordinates == COORDINATES
    assert arm.inputs == 3
    place = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in COORDINATES]
    finger = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "finger")
    whole = np.zeros((5, 4))
    whole[place, range(4)], whole[finger, 2] = 1, -0.5
    found = jax.jit(
        lambda q, v, u: (arm.space(q), acceleration(arm, jnp.zeros(()), q, v, u), arm.space.pose(q, "elbow"))
    )
    rng = np.random.default_rng(0)
    for _ in range(4):
        q, v, u = rng.normal(size=4), rng.normal(size=4), rng.normal(size=3)
        data.qpos[:] = whole @ q
        data.qpos[finger] += 0.01 + 0.5 * 0.1
        data.qvel[:], data.ctrl[:] = whole @ v, u
        mujoco.mj_forward(model, data)
        full = np.zeros((5, 5))
        mujoco.mj_fullM(model, data, full)
        matrix = whole.T @ full @ whole
        force = whole.T @ (data.qfrc_actuator + data.qfrc_passive - data.qfrc_bias)
        ours, rate, pose = found(q, v, u)
        np.testing.assert_allclose(ours, matrix, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(rate, np.linalg.solve(matrix, force), rtol=1e-9, atol=1e-9)
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "elbow")
        np.testing.assert_allclose(pose[:3, :3], data.xmat[body].reshape(3, 3), atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], data.xpos[body], atol=1e-12)


@pytest.mark.exhaustive
def test_units_and_limits_are_those_of_the_file(folder):
    bend = next(joint for joint in robots.read(folder / "arm.xml").joints if joint.name == "bend")
    np.testing.assert_allclose([bend.lower, bend.upper], np.deg2rad([-90, 120]))
    assert load(str(folder / "arm.xml")).columns.q == COORDINATES


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
    "closed loops": ("</equality>", '<connect body1="elbow" body2="stand" anchor="0 0 0"/></equality>'),
    "polynomial of an order above 1": ('"0.01 -0.5 0 0 0"', '"0.01 -0.5 0.1 0 0"'),
    "has a state of its own": ('<motor name="m1"', '<general dyntype="filter" dynprm="0.1" name="m1"'),
    "fluid": ('gravity="0.3 0 -9.7"', 'density="1.2"'),
    "gravcomp": ('<body name="elbow"', '<body gravcomp="1" name="elbow"'),
    "x.stl": ("<worldbody>", '<asset><mesh file="x.stl"/></asset><worldbody>'),
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
