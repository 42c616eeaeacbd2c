"""What takes long of `test_mjcf.py`."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_mjcf import ARM, FREE, arm, folder, inertia, moved

from covariant.models import acceleration, load, robots

COORDINATES = ("turn", "bend", "slide", "elbow")


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


@pytest.mark.exhaustive
def test_rotors_and_dampers_of_actuators_act_on_the_joints_by_the_square_of_the_gear(tmp_path):
    plain = moved(tmp_path, ARM)
    geared = moved(tmp_path, ARM.replace('gear="50"', 'gear="50" armature="2e-5" damping="4e-4"'))
    np.testing.assert_allclose(inertia(geared) - inertia(plain), np.diag([0.05, 0, 0, 0]), atol=1e-12)
    q, v = jnp.zeros(4), jnp.array([2.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(geared.dissipation(q, v) - plain.dissipation(q, v), [-2.0, 0, 0, 0], atol=1e-12)


def test_an_actuator_of_a_disabled_group_is_no_input_and_keeps_its_rotor(tmp_path):
    text = ARM.replace('name="m1"', 'group="1" armature="2e-5" name="m1"')
    disabled = moved(tmp_path, text.replace("<option gravity", '<option actuatorgroupdisable="1" gravity'))
    assert disabled.inputs == 2
    assert robots.read(tmp_path / "robot.xml").ignored["actuator (disabled group)"] == 1
    np.testing.assert_allclose((inertia(disabled) - inertia(moved(tmp_path, ARM)))[0, 0], 0.05)


@pytest.mark.exhaustive
def test_a_free_joint_has_the_dampers_rotors_and_friction_of_the_defaults(tmp_path):
    """Linear in the world and angular in the body; the rotors have no weight."""
    defaults = '<default><joint damping="0.5" armature="0.01" frictionloss="0.2"/></default><worldbody>'
    text = FREE.replace("<freejoint name", '<joint type="free" name').replace("<worldbody>", defaults)
    model, plain = moved(tmp_path, text), moved(tmp_path, FREE)
    added = inertia(model) - inertia(plain)
    np.testing.assert_allclose(added, 0.01 * np.eye(7), atol=1e-12)
    assert float(model.space.mass) == pytest.approx(float(plain.space.mass))
    (q, v) = model.manifold.retract(model.manifold.origin(), jnp.arange(1.0, 8) / 5), jnp.arange(-3.0, 4)
    turn = np.asarray(q[:16].reshape(4, 4)[:3, :3])
    rates = np.concatenate([turn @ v[:3], v[3:]])
    force = -0.5 * rates - 0.2 * 2 / np.pi * np.arctan(100 * rates)
    force[:3] = turn.T @ force[:3]
    np.testing.assert_allclose(model.dissipation(q, v), force, atol=1e-12)
    only_damped = moved(tmp_path, text, dry_friction=False)
    np.testing.assert_allclose(only_damped.dissipation(q, v), -0.5 * np.asarray(v), atol=1e-12)
    with pytest.raises(ValueError, match="joint 'free': the stiffness of a free joint is not supported"):
        moved(tmp_path, text.replace('damping="0.5"', 'damping="0.5" stiffness="1"'))


MUG = '<mujoco><worldbody><body name="mug" pos="0 0 1"><freejoint/><geom type="cylinder" size="0.04 0.05"/></body>'


@pytest.mark.exhaustive
def test_one_free_body_is_a_system_on_a_group(tmp_path):
    mug = moved(tmp_path, MUG + "</worldbody></mujoco>")
    assert (mug.coordinates, len(mug.velocities), mug.inputs) == ((), 6, 0)
    theirs = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    mass, moments = theirs.body_mass[1], theirs.body_inertia[1]
    np.testing.assert_allclose(inertia(mug), np.diag([mass] * 3 + list(moments)), atol=1e-12)
    q, v = mug.manifold.origin(), jnp.array([1.0, 2.0, 3.0, 0.0, 0.0, 2.0])
    # In the body's frame a velocity that is constant in the world turns: v' = g − ω × v.
    np.testing.assert_allclose(acceleration(mug, jnp.zeros(()), q, v, jnp.zeros(0))[:3], [4, -2, -9.81], atol=1e-9)


def test_a_mesh_that_is_missing_matters_only_where_an_inertia_follows_from_it(tmp_path):
    text = """<mujoco><asset><mesh name="link" file="link.stl"/><texture name="t" type="2d" file="t.png"/>
    <material name="m" texture="t"/><hfield name="hill" file="hill.png" size="1 1 1 1"/></asset><worldbody>
    <geom type="hfield" hfield="hill"/><geom type="mesh" mesh="link" name="named"/>
    <body name="arm"><inertial pos="0.1 0 0" mass="0.8" diaginertia="0.001 0.004 0.004"/>
    <joint name="hinge" axis="0 1 0"/><geom type="mesh" mesh="link" material="m"/><geom type="box" mesh="link"/></body>
    <body name="pole"><joint name="pole" axis="1 0 0"/><geom type="mesh" mesh="link" mass="0"/>
    <geom type="capsule" fromto="0 0 0 0 0 1" size="0.1"/></body></worldbody></mujoco>"""
    model = moved(tmp_path, text)
    assert float(inertia(model)[0, 0]) == pytest.approx(0.012, rel=1e-12)
    assert robots.read(tmp_path / "robot.xml").ignored["asset/mesh"] == 1
    with pytest.raises(ValueError, match="the inertia of body 'pole' follows from a mesh: give an <inertial>"):
        moved(tmp_path, text.replace(' mass="0"', ""))
    with pytest.raises(ValueError, match=r"link\.stl"):
        moved(tmp_path, text.replace("<mujoco>", '<mujoco><compiler inertiafromgeom="true"/>'))
