"""The intrinsic Kalman filter: its reset is exact, and it is the same in all coordinates."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.models import Lagrangian
from covariant.observers import IntrinsicKalman


def isotropic(model, process=0.5, measurement=0.02, velocity=1.0, **named) -> IntrinsicKalman:
    """A filter whose noise is the same in all directions of the metric, hence the same tensor in every chart."""
    return IntrinsicKalman(model, process**2, measurement**2, velocity**2, **named)


# The reset: how an error is seen from the estimate after a correction.


def double_pendulum() -> Lagrangian:
    chain = models.pendulum_chain((1.0, 0.7), (0.5, 0.4))
    return Lagrangian(chain.metric, chain.potential, coordinates=chain.coordinates)


# The lottery of coordinates.


NO_COVARIANCES = [
    ({"process_cov": -1.0}, "process_cov must have variances that are zero or more; its least is -1"),
    ({"process_cov": jnp.diag(jnp.array([1.0, -0.1]))}, "process_cov must have variances that are zero or more"),
    ({"measurement_cov": 0.0}, "measurement_cov must have variances that are positive; its least is 0"),
    ({"measurement_cov": np.ones((2, 2))}, "measurement_cov must have variances that are positive"),
    ({"initial_velocity_cov": np.array([[1.0, 0.5], [0.4, 1.0]])}, "initial_velocity_cov must be symmetric"),
    ({"initial_velocity_cov": np.ones(2)}, "initial_velocity_cov must be a number or a square matrix"),
    ({"initial_velocity_cov": np.nan}, "initial_velocity_cov must have finite entries"),
]


@pytest.mark.parametrize(("wrong", "words"), NO_COVARIANCES)
def test_what_is_no_covariance_is_refused(wrong, words):
    given = {"process_cov": 1.0, "measurement_cov": 1.0, "initial_velocity_cov": 1.0} | wrong
    with pytest.raises(ValueError, match=words):
        IntrinsicKalman(double_pendulum(), **given)


def test_no_process_noise_and_a_known_start_are_covariances():
    isotropic(double_pendulum(), 0.0, 0.1, 0.0)
