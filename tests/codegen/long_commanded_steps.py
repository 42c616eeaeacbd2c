"""What takes long of `test_commanded_steps.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import servo_machine
from test_commanded_steps import arm, file

import covariant
from covariant import models
from covariant.observers import ActingInputs, ModelCopy, run
from covariant.observers.base import needed_substeps

SETTLED = 25
"""Rows at the start that do not count."""


FORCE = {"uncertainty.external_force_std": [0.3, 0.3], "uncertainty.external_force_time": 1.0}


def errors(velocity, x) -> np.ndarray:
    return np.sqrt(np.mean((velocity - x[:, 2:])[SETTLED:] ** 2, axis=0))


@pytest.mark.exhaustive
def test_the_model_alone_follows_the_machine():
    """With a limit, dead bands, a switch, friction as steep as 15 N m s/rad and commands that jump, at 50 Hz."""
    log, x = servo_machine.run()
    alone = ActingInputs(ModelCopy(arm(), 1e-3, 1e-6), 50.0, (0.037, 0.012, 0.0), lead=(0.01, 0.0, 0.0))
    velocity = np.asarray(run(alone, log._replace(y=x[:, :2])).estimate)[:, 2:]
    assert np.abs(x[:, 2:]).max() > 4
    assert (errors(velocity, x) < 0.2).all()


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["intrinsic", "ekf", "lagrangian-metric"])
def test_a_velocity_is_estimated_from_commands(name, file):
    log, x = servo_machine.run()
    result = covariant.estimate(file, log, observer=name)
    assert (errors(result.velocity, x) < 0.1).all()  # of up to 4 rad/s
    assert result.outcome.counts["ok"] >= 0.99 * len(log.t)
    if name == "intrinsic":  # commands that act as they are sent tell another motion
        early = covariant.estimate(file, log, observer=name, overrides={"servo.shoulder.delay": 0.0})
        assert errors(early.velocity, x)[0] > 2 * errors(result.velocity, x)[0]


@pytest.mark.exhaustive
def test_a_torque_on_a_joint_is_estimated_from_commands(file):
    log, _ = servo_machine.run(pushed=True)
    result = covariant.estimate(file, log, observer="intrinsic-kalman", overrides=FORCE)
    force, std = (np.asarray(each) for each in (result.run.info.slow, result.run.info.slow_std))
    push = servo_machine.moves(0.02, len(log.t))[1]
    pushed = (log.t > 10) & (log.t < 11)
    np.testing.assert_allclose(force[pushed].mean(0), [0.0, 0.4], atol=0.15)
    assert abs(force[pushed, 1].mean() - 0.4) < 0.04
    true = np.stack([np.zeros_like(push), push], axis=1)
    assert ((np.abs(force - true) < 2 * std)[SETTLED:].mean(0) > 0.9).all()


@pytest.mark.exhaustive
def test_stiff_friction_takes_as_many_substeps_as_it_needs():
    model, u = arm(), jnp.array([0.5, -0.5, 1.0])
    still, fast = (needed_substeps(model, 0.0, jnp.zeros(2), jnp.full(2, v), u, 0.02).item() for v in (0.0, 3.0))
    assert still == fast  # as steep as at rest, which it may come to within a step
    assert 5 < still < 100
    rate = jax.jacfwd(lambda v: models.friction(model, jnp.zeros(()), jnp.zeros(2), v, u))(jnp.zeros(2))
    assert still >= 0.02 * np.abs(np.linalg.eigvals(rate)).max()
