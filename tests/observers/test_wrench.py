"""Forces on links: what they do to the joints is what MuJoCo says, and a filter finds those that the joints feel."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import covariant
from covariant import models
from covariant.models import robots
from covariant.observers import IntrinsicKalman, external_force, wrench
from covariant.signals import Record

STEP, ROWS = 0.01, 600
STAMPS = STEP * np.arange(ROWS)


@pytest.fixture(scope="module")
def arm():
    return robots.load("double_pendulum")


@pytest.mark.long
@pytest.mark.parametrize(("robot", "link"), [("double_pendulum", "lower"), ("panda", "panda_link7")])
def test_its_torques_are_those_of_mujoco(robot, link):
    model = robots.load(robot)
    theirs = mujoco.MjModel.from_xml_string(robots.located(robot).read_text(encoding="utf-8"))
    data, rng = mujoco.MjData(theirs), np.random.default_rng(0)
    body = mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_BODY, link)
    order = [mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_JOINT, name) for name in model.coordinates]
    place = np.array([0.1, -0.05, 0.2])
    for _ in range(3):
        q, w = rng.uniform(-2, 2, len(order)), rng.normal(size=6)
        data.qpos[theirs.jnt_qposadr[order]] = q
        mujoco.mj_forward(theirs, data)
        rotation = data.xmat[body].reshape(3, 3)
        at = data.xpos[body] + rotation @ place
        for frame in ("link", "world"):
            force, torque = (rotation @ part if frame == "link" else part for part in (w[:3], w[3:]))
            felt = np.zeros(theirs.nv)
            mujoco.mj_applyFT(theirs, data, force, torque, at, body, felt)
            ours = wrench(model.space, link, 1.0, 1.0, time=1.0, frame=frame, point=place)
            assert ours.names == tuple(f"{axis}_{link}" for axis in ("fx", "fy", "fz", "tx", "ty", "tz"))
            got = ours.force(jnp.asarray(q), jnp.zeros(len(q)), jnp.asarray(w))
            np.testing.assert_allclose(got, felt[theirs.jnt_dofadr[order]], atol=1e-9)


MODEL = """
system = "robot"

[parameters]
path = "double_pendulum"

[measurement]
std = 1e-4

[uncertainty]
acceleration = 0.2
external_force_std = 0.05
external_force_time = 0.3

[wrench.tip]
link = "lower"
force_std = [2.0, 0.0, 2.0]
time = 0.5
point = [0.0, 0.0, -0.2]
"""


@pytest.mark.exhaustive
def test_a_model_file_names_forces_and_every_engine_estimates_them(tmp_path):
    model = tmp_path / "arm.toml"
    model.write_text(MODEL)
    log = covariant.simulate(model, duration=1.0, rate=100.0, amplitude=[0.5, 0.2], noise=1e-4).record
    c, jaxs = (covariant.estimate(model, log, observer="intrinsic-kalman", engine=e).columns for e in ("c", "jax"))
    assert list(c)[-9:] == [
        *("fx_tip", "fz_tip", "external_force1", "external_force2"),
        *(f"{name}_std" for name in ("fx_tip", "fz_tip", "external_force1", "external_force2")),
        "pushed",
    ]
    for name, column in c.items():
        np.testing.assert_allclose(column, jaxs[name], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"wrench.tip.link": "hand"}, r"\[wrench.tip\]: unknown link 'hand'. Known: base, upper, lower"),
        ({"wrench.tip.force_std": -1.0}, r"\[wrench.tip\]: force_std must be one number or three, numbers ≥ 0; got -1"),
        ({"wrench.tip.force_std": 0.0}, r"all zero; give the usual size"),
        ({"wrench.tip.frame": "base"}, r"frame must be one of link, world; got 'base'"),
        ({"wrench.tip.time": 0.0}, r"time"),
        ({"wrench.tip.std": 1.0}, r"unknown key of \[wrench.tip\] 'std'"),
        ({"wrench.tool.link": "lower"}, r"\[wrench.tool\] needs force_std and time"),
        ({"wrench.tool": 3.0}, r"wrench.tool must be a table"),
    ],
)
def test_what_makes_no_sense_is_named(change, words, tmp_path):
    model = tmp_path / "arm.toml"
    model.write_text(MODEL)
    log = Record(STAMPS, np.zeros((ROWS, 2)), 0.1 * np.sin(np.stack([STAMPS, 2 * STAMPS], axis=1)))
    with pytest.raises(ValueError, match=words):
        covariant.estimate(model, log, observer="intrinsic-kalman", overrides=change, anyway=True)


def test_only_robots_have_links():
    with pytest.raises(ValueError, match="has no links; give the space of a robot"):
        wrench(models.oscillator().space, "hand", 1.0, time=1.0)


def test_beside_friction_states_it_has_names_of_its_own(arm):
    slow = (external_force(std=[0.1, 0.1], time=0.2), wrench(arm.space, "lower", 1.0, time=1.0))
    filter_ = IntrinsicKalman(arm, 1e-4, 1e-8 * jnp.eye(2), jnp.eye(2), slow)
    assert filter_.slow_names == ("external_force1", "external_force2", "fx_lower", "fy_lower", "fz_lower")
