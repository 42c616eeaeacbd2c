"""What takes long of `test_model_free_filters.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_model_free_filters import STAMPS

from covariant.observers import FilteredDerivative, SavitzkyGolay, run
from covariant.signals import Record


def test_filters_are_exact_on_what_they_model_at_irregular_stamps():
    t = np.asarray(STAMPS)
    y = np.stack([2 * t + 1, -t], axis=1)
    y[5:200:7] = np.nan
    ramp = Record(STAMPS, jnp.zeros((len(t), 0)), jnp.asarray(y))
    assert np.allclose(run(FilteredDerivative(80.0), ramp).estimate[-1], [y[-1, 0], y[-1, 1], 2.0, -1.0], atol=1e-6)
    curve = ramp._replace(y=jnp.asarray(y**2))
    expected = [y[-1, 0] ** 2, y[-1, 1] ** 2, 4 * y[-1, 0], 2 * t[-1]]
    assert np.allclose(run(SavitzkyGolay(15, 2), curve).estimate[-1], expected, atol=1e-5)


@pytest.mark.parametrize(("window", "order"), [(4, 1), (7, 3), (25, 3)])
def test_polynomials_of_its_order_are_exact_once_the_window_is_full(window, order):
    t = np.asarray(STAMPS) * 10
    shape = np.polynomial.Polynomial(np.random.default_rng(order).normal(size=order + 1))
    x = np.asarray(run(SavitzkyGolay(window, order), Record(t, np.zeros((len(t), 0)), shape(t)[:, None])).estimate)
    full = slice(window, None)
    scale = np.abs(shape.deriv()(t)).max()
    np.testing.assert_allclose(x[full, 0], shape(t)[full], rtol=0, atol=1e-6 * scale)
    np.testing.assert_allclose(x[full, 1], shape.deriv()(t)[full], rtol=0, atol=1e-4 * scale)
