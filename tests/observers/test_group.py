"""Observers on groups: stated behaviour at the edges, and the Kalman filter against a textbook's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import free_body, robots, underwater_vehicle
from covariant.observers import EKF, Geodesic, Intrinsic, Salcudean, run
from covariant.signals import Record

BODY = free_body((1.0, 2.0, 3.5))
OBSERVERS = {
    "group": Intrinsic(BODY, 4.0, 6.0, substeps=1),
    "riemannian": Geodesic(BODY, 4.0, 6.0, substeps=1),
    "invariant EKF": EKF(BODY, 1e-3 * jnp.eye(3), 1e-4 * jnp.eye(3), substeps=1),
    "salcudean": Salcudean(BODY, 96.0, 16.0, substeps=1),
}


@pytest.mark.core(1)
@pytest.mark.parametrize("name", OBSERVERS)
def test_a_first_measurement_that_is_no_rotation_is_refused(name):
    start = jax.jit(OBSERVERS[name].init)
    assert np.isfinite(start(jnp.eye(3)).q).all()
    for wrong in (2 * jnp.eye(3), -jnp.eye(3), jnp.full((3, 3), jnp.nan)):
        with pytest.raises(ValueError, match="not an element of the group"):
            OBSERVERS[name].init(wrong)
        assert np.isnan(start(wrong).q).all()
    with pytest.raises(ValueError, match="not an element of the group"):
        OBSERVERS[name].init(jnp.eye(3).at[0, 1].set(jnp.nan))
    # A program that calls Python is not kept.
    assert "callback" not in start.lower(jnp.eye(3)).as_text()


def test_a_pose_that_is_none_leaves_the_joints_measured():
    arm = robots.load("quadruped")
    y = np.array(jnp.broadcast_to(arm.manifold.origin(), (4, *arm.manifold.shape)))
    y[2, :9] *= 2  # the rotation
    found = jax.vmap(arm.manifold.admitted)(jnp.asarray(y))
    assert np.isnan(found[2]).sum() == 16
    np.testing.assert_array_equal(found[2, 16:], y[2, 16:])
    with pytest.raises(ValueError, match="row 3: the measurement is no configuration"):
        run(Intrinsic(arm, 4.0, 8.0, substeps=1), Record(0.02 * np.arange(4.0), np.zeros((4, 8)), y))


def test_salcudean_is_for_rotations_only():
    with pytest.raises(ValueError, match=r"the observer is for SO\(3\) only"):
        Salcudean(underwater_vehicle(), 1.0, 1.0)
