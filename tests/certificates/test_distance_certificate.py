"""Certificates by distance, against the library's geometry, simulated estimates, and where they must not hold."""

import jax.numpy as jnp
import pytest

from covariant import models, observers
from covariant.certificates import certify_distance
from covariant.models import Lagrangian
from covariant.observers import LagrangianMetric

FLAT = Lagrangian(lambda q: jnp.diag(jnp.array([1.0, 4.0])), lambda q: q[0] ** 2, coordinates=("x", "y"), inputs=2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LagrangianMetric(models.pendulum_chain(viscous=(0.1, 0.1)), 1.0, 1.0), "friction"),
        (lambda: LagrangianMetric(models.pendulum_chain((1.0,), (1.0,)), 1.0, 1.0), "two coordinates"),
        (lambda: observers.Intrinsic(FLAT, 1.0, 1.0), "Intrinsic"),
    ],
)
def test_what_is_not_covered_is_refused(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        certify_distance(make(), interval=0.01, position=(-1.0, 1.0), velocity=1.0, error=0.1)
