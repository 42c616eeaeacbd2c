"""Transmissions of URDF: a rotor behind a gear is felt as n² J, and only where the file states one: what takes long."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_transmissions import EACH, PLAIN, ROTOR, load, read

from covariant import models
from covariant.models import acceleration, robots


@pytest.mark.exhaustive
def test_the_inertia_matrix_has_it_on_the_diagonal(read):
    geared, plain = (robots.assemble(read(text), lock={"tip": 0.0}) for text in (PLAIN + ROTOR, PLAIN))
    q = jnp.array([0.3, -0.7])
    np.testing.assert_allclose(geared.space(q) - plain.space(q), np.diag([0.0, 0.2]), atol=1e-14)


@pytest.mark.exhaustive
def test_torques_of_motors_are_felt_behind_their_gears(load):
    """n times as large, the sign of the reduction included; what a rotor is felt as does not change."""
    at_joints, at_motors = load(EACH), load(EACH, motor_torques=True)
    q, v, t = jnp.array([0.3, -0.7]), jnp.array([1.0, 2.0]), jnp.zeros(())
    felt = acceleration(at_joints, t, q, v, jnp.array([-50 * 0.02, 100 * 0.03]))
    np.testing.assert_allclose(acceleration(at_motors, t, q, v, jnp.array([0.02, 0.03])), felt, rtol=1e-12)
    np.testing.assert_array_equal(at_motors.space(q), at_joints.space(q))
    only = load(EACH, motor_torques=True, actuated=["hand"])
    felt = acceleration(at_joints, t, q, v, jnp.array([0.0, 3.0]))
    np.testing.assert_allclose(acceleration(only, t, q, v, jnp.array([0.03])), felt, rtol=1e-12)


@pytest.mark.exhaustive
def test_a_payload_in_a_model_file_may_hold_whole_numbers(read, tmp_path):
    read(EACH)
    file = models.load(str(tmp_path / "geared.urdf"), ("parameters.payload={hand=[1, 0, 0.5, 0]}",))
    plain = robots.load(tmp_path / "geared.urdf")
    assert float(file.need_mechanical("", "").space.mass - plain.space.mass) == pytest.approx(1.0)
