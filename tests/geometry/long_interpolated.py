"""Laws of a metric interpolated between the points of a grid: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_interpolated import HIGH, LOW, at, axes_of, field, grid_points, made, oscillator_metric

from covariant.geometry import Interpolated


@pytest.mark.exhaustive
def test_third_order_in_the_spacing():
    x = np.random.default_rng(2).uniform(LOW, HIGH, (3000, 3))
    counts = np.array([9, 17, 33])
    errors = [np.abs(np.asarray(at(made(int(n)), x)) - oscillator_metric(x)).max() for n in counts]
    order = -np.polyfit(np.log(counts - 1), np.log(errors), 1)[0]
    assert 2.8 < order < 4.2, errors
    assert errors[-1] < 1e-5


@pytest.mark.exhaustive
def test_gradient_is_that_of_the_values_and_continuous_across_cells(field):
    rng = np.random.default_rng(3)
    gradient = jax.jit(jax.vmap(jax.jacfwd(field)))
    x, step = rng.uniform(LOW + 0.01, HIGH - 0.01, (50, 3)), 1e-6
    differences = [(at(field, x + step * e) - at(field, x - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(gradient(x), np.stack(differences, -1), rtol=0, atol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.jacrev(field)))(x), gradient(x), rtol=0, atol=1e-12)
    for k in range(3):
        border = x.copy()
        border[:, k] = LOW[k] + (HIGH[k] - LOW[k]) / 8 * rng.integers(1, 8, 50)
        hair = 1e-9 * np.eye(3)[k]
        np.testing.assert_allclose(gradient(border - hair), gradient(border + hair), rtol=0, atol=1e-7)


@pytest.mark.exhaustive
def test_nan_outside_and_near_points_without_a_metric_only():
    axes = axes_of(LOW, HIGH, (9, 9, 9))
    values = oscillator_metric(grid_points(axes))
    hole = np.array([5, 1, 8])
    values[tuple(hole)] = np.inf
    field, spacing = Interpolated(axes, values), (HIGH - LOW) / 8
    rng = np.random.default_rng(4)
    x = rng.uniform(LOW - 2 * spacing, HIGH + 2 * spacing, (20_000, 3))
    nan = np.isnan(np.asarray(at(field, x)))
    assert (nan.all(axis=(1, 2)) == nan.any(axis=(1, 2))).all()
    outside = ((x < LOW) | (x > HIGH)).any(axis=1)
    near = (np.abs((x - LOW) / spacing - hole) < 2).all(axis=1)
    np.testing.assert_array_equal(nan[:, 0, 0], outside | near)
    assert (near & ~outside).sum() > 50
    np.testing.assert_array_equal(jax.vmap(field.contains)(x), ~outside)
    for strange in (np.nan, np.inf, -np.inf, 1e300):
        assert np.isnan(field(jnp.array([strange, 1.2, 1.0]))).all()


@pytest.mark.exhaustive
def test_single_precision(field):
    axes = tuple(axis.astype(np.float32) for axis in axes_of(LOW, HIGH, (9, 9, 9)))
    single = Interpolated(axes, oscillator_metric(grid_points(axes)).astype(np.float32))
    assert single.factors.dtype == np.float32
    x = np.random.default_rng(5).uniform(LOW, HIGH, (100, 3))
    for each in (field, single):
        found = at(each, x.astype(np.float32))
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, oscillator_metric(x), rtol=0, atol=5e-4)
        assert at(each, x).dtype == np.float64
    np.testing.assert_array_equal(at(single, grid_points(axes)[-1, -1, -1:].astype(np.float32)).shape, (1, 3, 3))
    assert np.isfinite(at(single, grid_points(axes).reshape(-1, 3))).all()
