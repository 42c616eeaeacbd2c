"""What takes long of `test_ball_joints.py`."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_ball_joints import ARM, INERTIAL

from covariant.geometry import Metric
from covariant.geometry.lie import SO3
from covariant.models import MechanicalSystem, acceleration, load, robots, survey

TEXT = ARM.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def arm():
    return robots.load(ARM)


@pytest.mark.exhaustive
def test_a_ball_joint_moves_as_in_mujoco(arm):
    """Anchor beside the frame of the body, rotor, spring, damper, torques about axes of the body."""
    model = mujoco.MjModel.from_xml_string(TEXT)
    data = mujoco.MjData(model)
    assert arm.coordinates == ("turn", "rod")
    assert arm.velocities == ("w1_shoulder", "w2_shoulder", "w3_shoulder", "rate_turn", "rate_rod")
    assert arm.inputs == 3
    order = np.array([1, 2, 3, 0, 4])  # of their velocities
    found = jax.jit(lambda q, v, u: (arm.space(q), acceleration(arm, jnp.zeros(()), q, v, u), arm.space.pose(q, "rod")))
    rng = np.random.default_rng(0)
    for _ in range(4):
        turn, angles, v, u = SO3.exp(jnp.asarray(rng.normal(size=3))), rng.normal(size=2), *rng.normal(size=(2, 5))
        data.qpos[[0, 5]] = angles
        mujoco.mju_mat2Quat(data.qpos[1:5], np.asarray(turn).ravel())
        data.qvel[order], data.ctrl[:] = v, u[:3]
        mujoco.mj_forward(model, data)
        full = np.zeros((5, 5))
        mujoco.mj_fullM(model, data, full)
        ours, rate, pose = found(jnp.concatenate([turn.reshape(-1), jnp.asarray(angles)]), v, u[:3])
        np.testing.assert_allclose(ours, full[np.ix_(order, order)], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(rate, data.qacc_smooth[order], rtol=1e-9, atol=1e-9)
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "rod")
        np.testing.assert_allclose(pose[:3, :3], data.xmat[body].reshape(3, 3), atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], data.xpos[body], atol=1e-12)


@pytest.mark.exhaustive
def test_one_ball_joint_alone_is_a_body_on_a_point(tmp_path):
    """The configuration is one attitude, and logs hold it as that of a satellite."""
    path, kinds = tmp_path / "top.urdf", []
    for kind in ("ball", "spherical"):
        path.write_text(
            f'<robot name="top"><link name="base"/><link name="top">{INERTIAL}</link>'
            f'<joint name="tip" type="{kind}"><parent link="base"/><child link="top"/></joint></robot>'
        )
        kinds.append(robots.read(path).joints[0].kind)
    assert kinds == ["ball", "ball"]
    names = ["qw", "qx", "qy", "qz"]
    file = load(str(path), [f"columns.quaternion_wxyz={names}".replace("'", '"')])
    assert (file.columns.measured, file.unnamed_attitudes) == (tuple(names), 0)
    top = file.model
    assert top.manifold == SO3
    r = np.array([0.1, 0.05, -0.2])
    about_centre = np.array([[0.02, 0.001, 0], [0.001, 0.03, 0], [0, 0, 0.025]])
    at_tip = about_centre + 2 * (r @ r * np.eye(3) - np.outer(r, r))
    turn = SO3.exp(jnp.array([0.3, -0.4, 0.5]))
    np.testing.assert_allclose(top.space(turn), at_tip, atol=1e-14)
    assert float(top.potential(turn)) == pytest.approx(2 * 9.81 * float(turn[2] @ r), rel=1e-12)


@pytest.mark.exhaustive
def test_logs_hold_an_attitude_for_the_base_and_one_for_each_ball_joint(tmp_path):
    """Eight columns of quaternions, the base first; a number that fits no attitude is refused."""
    path = tmp_path / "flyer.toml"
    names = [f"{q}_{body}" for body in ("base", "shoulder") for q in ("qw", "qx", "qy", "qz")]
    flying = TEXT.replace('<joint name="turn" axis="0 0 1" damping="0.1"/>', '<freejoint name="free"/>')
    (tmp_path / "flyer.xml").write_text(flying.replace('<motor name="m1" joint="turn" gear="20"/>', ""))
    text = '[parameters]\npath = "flyer.xml"\n[columns]\nquaternion_wxyz = ' + str(names)
    path.write_text('system = "robot"\n' + text.replace("'", '"'))
    file = load(str(path))
    assert file.model.manifold.shape == (16 + 9 + 1,)
    assert file.dimension == 6 + 3 + 1
    assert file.columns.quaternion_wxyz == tuple(names)
    assert load(str(path), ["columns.quaternion_wxyz=[]"]).unnamed_attitudes == 2
    with pytest.raises(ValueError, match=r"names 4 columns.*so written 2 attitudes has 8 entries"):
        load(str(path), ['columns.quaternion_wxyz=["a", "b", "c", "d"]'])


@pytest.mark.exhaustive
def test_a_survey_turns_what_is_no_coordinate():
    space = Metric(lambda x: jnp.diag(jnp.stack([1.0, 1.0, 2 + x[0, 0]])), manifold=SO3)
    low, high = survey(MechanicalSystem(space), None, 50).conditioning
    assert 1 < low < 1.5 < 2.5 < high < 3


WRONG = {
    "along an axis of its parent": ('<motor name="m2" joint=', '<motor name="m2" jointinparent='),
    "is a servo on the ball joint 'shoulder'": (
        '<motor name="m2" joint="shoulder" gear="3 0 -1 0 0 0"/>',
        '<position name="m2" joint="shoulder" kp="3"/>',
    ),
}


@pytest.mark.parametrize("words", WRONG)
def test_a_motor_of_a_ball_joint_that_is_no_torque_in_the_body_is_refused(words, tmp_path):
    old, new = WRONG[words]
    assert old in TEXT
    (tmp_path / "broken.xml").write_text(TEXT.replace(old, new))
    with pytest.raises(ValueError, match=rf"broken\.xml: actuator 'm2' .*{words}, which is not supported"):
        robots.load(tmp_path / "broken.xml")
    assert robots.load(tmp_path / "broken.xml", actuated=["turn"]).inputs == 1
