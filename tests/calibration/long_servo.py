"""A servo whose friction depends on the direction and sticks: its fit predicts as the true numbers do."""

import runpy
from pathlib import Path

import numpy as np
import pytest

servo = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "servo.py"))
Servo = servo["Servo"]


@pytest.mark.exhaustive
def test_the_servo_of_the_benchmark_is_the_robot_of_its_file(tmp_path):
    """The closed form in NumPy against the robot that is fitted."""
    import jax
    import jax.numpy as jnp

    from covariant import models

    (tmp_path / "servo.urdf").write_text(servo["URDF"])
    truth = Servo()
    law = {"hinge": {name: getattr(truth, name) for name in Servo._fields[1:]}}
    robot = models.robots.load(str(tmp_path / "servo.urdf"), armature={"hinge": truth.armature}, friction=law)
    v, u = np.random.default_rng(0).normal(size=(2, 50, 1)) * 0.1
    q, t = np.zeros(1), jnp.zeros(())
    ours = jax.vmap(lambda v, u: models.acceleration(robot, t, jnp.asarray(q), v, u))(v, u)
    np.testing.assert_allclose(ours, truth.acceleration(v, u), rtol=1e-9)


@pytest.mark.exhaustive
def test_a_fit_of_asymmetric_and_sticking_friction_predicts_as_the_true_numbers_do():
    record, v = servo["logged"](Servo(), 60.0)
    result, _ = servo["fitted"](record, "friction,friction.stribeck,armature")
    assert result.better
    fitted, true = (servo["prediction_error"](each, record, v) for each in (servo["servo_of"](result), Servo()))
    assert fitted < 1.2 * true, (fitted, true, result.values)
    without = Servo()._replace(asymmetry=0.0, stribeck=0.0)
    assert servo["prediction_error"](without, record, v) > 1.5 * true, "the log shows both"
