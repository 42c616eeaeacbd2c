"""Forces that the model does not know, at joints and on links: in MuJoCo, which shares no code with ours."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import covariant
from covariant import models
from covariant.models import pendulum_chain, robots
from covariant.observers import IntrinsicKalman, external_force, wrench
from covariant.signals import Record

RATE = 500.0
QUANTUM = 2 * np.pi / 2**16
MASS, LENGTH = (1.2, 0.8), (0.4, 0.3)
CHAIN = f"""
<mujoco>
  <option timestep="2e-4" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body><joint name="one" axis="0 -1 0"/>
      <inertial pos="0 0 -{LENGTH[0]}" mass="{MASS[0]}" diaginertia="1e-9 1e-9 1e-9"/>
      <body pos="0 0 -{LENGTH[0]}"><joint name="two" axis="0 -1 0"/>
        <inertial pos="0 0 -{LENGTH[1]}" mass="{MASS[1]}" diaginertia="1e-9 1e-9 1e-9"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
PUSH = np.array([1.5, -0.6])
"""N m at the two joints, from the second second on."""


@pytest.fixture(scope="module")
def pushed_swing() -> tuple[Record, np.ndarray]:
    """Four seconds, encoders with steps, torques that are known and a push that is not; and the true velocities."""
    model = mujoco.MjModel.from_xml_string(CHAIN)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.6, -0.4), (0.5, 1.0)
    t = np.arange(round(4 * RATE)) / RATE
    u = np.stack([2 * np.sin(3 * t), np.cos(5 * t)], axis=1)
    y, v = np.empty((len(t), 2)), np.empty((len(t), 2))
    for k in range(len(t)):
        y[k], v[k] = data.qpos, data.qvel
        data.qfrc_applied[:] = u[k] + PUSH * (t[k] >= 1.0)
        mujoco.mj_step(model, data, nstep=10)
    return Record(t, u, QUANTUM * np.round(y / QUANTUM)), v


def kalman(force: float | None, **named) -> IntrinsicKalman:
    noise = jnp.eye(2) * QUANTUM**2 / 12
    slow = () if force is None else (external_force(force * jnp.eye(2)),)
    return IntrinsicKalman(
        pendulum_chain(MASS, LENGTH), 1e-4 * jnp.eye(2), noise, 4.0 * jnp.eye(2), slow=slow, substeps=1, **named
    )


def test_its_covariance_is_one_matrix(pushed_swing):
    observer = kalman(1.0)
    state = observer.init(jnp.array(pushed_swing[0].y[0]))
    assert observer.cov(state).shape == (6, 6)
    assert kalman(None).cov(kalman(None).init(jnp.zeros(2))).shape == (4, 4)
    with pytest.raises(ValueError, match="density must have finite entries"):
        kalman(np.nan)


# Forces on links of a robot

STEP, ROWS = 0.01, 600
STAMPS = STEP * np.arange(ROWS)


@pytest.fixture(scope="module")
def arm():
    return robots.load("double_pendulum")


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


@pytest.mark.core(4)
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
