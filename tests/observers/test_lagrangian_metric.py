"""The implicit geodesic observer: its step in numbers, in other coordinates, and what an error becomes by it."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from covariant.geometry import Euclidean
from covariant.models import Lagrangian
from covariant.observers import LagrangianMetric


def test_a_step_in_a_flat_space_in_numbers():
    """α h = 3 takes three quarters of the error away, and σ = 2 times that is added to the velocity."""
    free = Lagrangian(Euclidean(), inputs=1)
    observer = LagrangianMetric(free, 6.0, 12.0)
    state = observer.init(jnp.zeros(1))._replace(v=jnp.ones(1))
    state, info = observer.step(state, jnp.zeros(1), jnp.array([8.5]), 0.5)
    assert info.innovation.tolist() == [8.0]
    assert info.distance.item() == 8.0
    np.testing.assert_allclose([state.q.item(), state.v.item()], [0.5 + 6.0, 1.0 + 12.0], rtol=1e-14)


@pytest.mark.parametrize(("k", "sigma"), [(4.0, 1.0), (4.0, 5.0), (9.81, 6.0), (0.0, 3.0), (-4.0, 5.0), (-4.0, 1.0)])
def test_the_largest_gain_is_stable_up_to_the_interval_in_closed_form(k, sigma):
    """A step of (ξ, w) with θ = 1: the exponential of the error law, then the correction."""
    root = math.sqrt(abs(k))
    slow, fast = sorted((sigma, root))
    if k > 0:
        longest = 2 / root * math.atan(root / sigma)
    else:
        longest = 2 / root * math.atanh(slow / fast) if k < 0 else 2 / sigma
    law = np.array([[sigma, 1.0], [-(k + sigma**2), -sigma]])
    steps = [np.diag([0.0, 1.0]) @ expm(share * longest * law) for share in (0.999, 1.001)]
    radius = [np.abs(np.linalg.eigvals(step)).max() for step in steps]
    assert radius[0] < 1 < radius[1]


# The same estimate in all coordinates
