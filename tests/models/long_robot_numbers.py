"""What takes long of `test_robot_numbers.py`."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_robot_numbers import HEAVY

from covariant import models
from covariant.models import ModelError, robots

NAMES = ("shoulder", "elbow")


ZERO = jnp.zeros(())


def accelerations(model, seed: int = 0):
    """At five random states, with the states."""
    q, v, u = np.random.default_rng(seed).normal(size=(3, 5, 2))
    return jax.vmap(lambda q, v, u: models.acceleration(model, ZERO, q, v, u))(q, v, u), q, v, u


@pytest.mark.exhaustive
def test_inertia_rotors_and_gravity_are_those_of_mujoco():
    """MuJoCo reads the URDF file that has the inertia, and is told the rotors and the gravity."""
    text = robots.urdf_with_inertias("double_pendulum", {"lower": HEAVY})
    theirs = mujoco.MjModel.from_xml_string(text.replace('friction="0.02"', "").replace('friction="0.01"', ""))
    theirs.dof_armature[:] = [0.01, 0.004]
    theirs.opt.gravity[:] = [0.0, 0.0, -3.7]
    data = mujoco.MjData(theirs)
    ours = robots.load(
        "double_pendulum",
        inertia={"lower": HEAVY},
        armature=dict(zip(NAMES, (0.01, 0.004), strict=True)),
        gravity=3.7,
        friction={name: {"viscous": b} for name, b in zip(NAMES, (0.01, 0.006), strict=True)},
    )
    rates, *states = accelerations(ours)
    for rate, q, v, u in zip(rates, *states, strict=True):
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, u
        mujoco.mj_forward(theirs, data)
        np.testing.assert_allclose(rate, data.qacc_smooth, rtol=1e-9, atol=1e-9)


@pytest.mark.exhaustive
def test_offsets_constants_and_friction_are_what_they_say():
    plain = robots.load("double_pendulum", friction={name: {} for name in NAMES})
    law = {"viscous": 0.1, "coulomb": 0.3, "asymmetry": -0.1, "stribeck": 0.2, "stribeck_velocity": 0.5}
    changed = robots.load(
        "double_pendulum",
        friction={"shoulder": law, "elbow": {}},
        torque_constants={"elbow": 1.3},
        offsets={"shoulder": 0.2},
    )
    _, q, v, u = accelerations(plain)
    v[:2] *= 0.03
    sign = np.tanh(v[:, 0] / 0.02)
    friction = 0.1 * v[:, 0] + (0.3 + 0.2 * np.exp(-((v[:, 0] / 0.5) ** 2))) * sign - 0.1 * sign**2
    acting = u * [1.0, 1.3] - np.stack([friction, np.zeros(5)], axis=1)
    expected = jax.vmap(lambda q, v, u: models.acceleration(plain, ZERO, q, v, u))(q + np.array([0.2, 0.0]), v, acting)
    ours = jax.vmap(lambda q, v, u: models.acceleration(changed, ZERO, q, v, u))(q, v, u)
    np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.exhaustive
def test_every_coordinate_of_an_inertia_is_a_body_that_exists():
    family = models.robot_family("double_pendulum", ["inertia.lower"])
    np.testing.assert_allclose(family.values(np.zeros(10)), family.first, atol=1e-15)
    values = jax.jit(family.values)
    for x in np.random.default_rng(0).normal(size=(20, 10)):
        moved = np.asarray(values(x))
        body = robots.inertia_of("lower", moved)
        assert np.linalg.eigvalsh(robots.inertia_of("lower", moved).second).min() > 0
        moments = np.linalg.eigvalsh(body.about_centre)
        assert moments[2] < moments[0] + moments[1], "the triangle inequality of principal moments"
        np.testing.assert_allclose(robots.numbers_of(body), moved, rtol=1e-9, atol=1e-12)
    linear = np.asarray(family.linear(np.zeros(10)))
    np.testing.assert_allclose(linear[[0, 3, 5]], [0.4, 0.4 * -0.13, 0.0025 + 0.4 * 0.13**2], rtol=1e-12)


@pytest.mark.exhaustive
def test_a_family_makes_the_robot_of_its_numbers():
    """What a compiled function makes of the coordinates is the robot of the written file."""
    family = models.robot_family(
        "double_pendulum", ["friction.2", "armature", "payload", "inertia.upper", "gravity", "torque_constants"]
    )
    x = 0.1 * np.random.default_rng(1).normal(size=len(family.names))
    x[:2] = [0.1, 0.2]
    x[3:6] = 0.1
    x[-2:] = [0.1, -0.2]
    q, v, u = jnp.asarray(np.random.default_rng(2).normal(size=(3, 2)))
    compiled = jax.jit(lambda x: models.acceleration(family.make(x), ZERO, q, v, u))(x)
    content = family.with_values(np.asarray(family.values(x)))
    overrides = {f"parameters.{key}": value for key, value in content["parameters"].items()}
    written = models.load("double_pendulum", overrides).model
    np.testing.assert_allclose(compiled, models.acceleration(written, ZERO, q, v, u), rtol=1e-9)


@pytest.mark.exhaustive
def test_only_robots_that_stand_are_fitted():
    with pytest.raises(ModelError, match="its base must stand still"):
        models.robot_family("quadruped", ["friction"])
    with pytest.raises(ModelError, match="are numbers of a robot, and this model is 'oscillator'"):
        models.robot_family("oscillator", ["friction"])
