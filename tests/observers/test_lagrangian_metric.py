"""The implicit geodesic observer: its step in numbers, in other coordinates, and what an error becomes by it."""

import jax.numpy as jnp
import numpy as np

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


# The same estimate in all coordinates
