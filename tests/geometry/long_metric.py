"""The functions every user calls: what they accept, the shapes and types they keep, norms at zero: what takes long."""

import jax
import numpy as np
import pytest
from test_metric import P, V, W, stretched

from covariant import geometry
from covariant.geometry._functions import norm


@pytest.mark.exhaustive
def test_plain_callable_is_a_metric():
    assert isinstance(geometry.as_space(stretched), geometry.Metric)
    for operation, arguments in (
        (geometry.christoffel, (V, W)),
        (geometry.curvature, (V, W, V)),
        (geometry.exp, (V,)),
        (norm, (V,)),
    ):
        by_callable = operation(stretched, P, *arguments)
        np.testing.assert_array_equal(by_callable, operation(geometry.Metric(stretched), P, *arguments))


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["sphere", "hyperbolic", "oscillator in r"])
def test_single_precision_agrees_with_double(spaces, name):
    """To 1e-5, a hundred roundings of single precision; the search for a geodesic converges in either."""
    space = spaces[name]
    samples = space.p, space.velocity, space.x[:, None]
    double = space.shoot(space.p, space.q), space.fly(*samples)
    p, q, *samples = (np.asarray(a, np.float32) for a in (space.p, space.q, *samples))
    single = space.shoot(p, q), space.fly(p, *samples[1:])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), single, double)
