"""Laws of a metric interpolated between the points of a grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from covariant.geometry import Interpolated
from covariant.papers.sanfelice_praly import analytic_metric

LOW, HIGH = np.array([0.0, 1.0, 0.5]), np.array([1.0, 1.5, 1.5])
"""The grid of section III of Sanfelice & Praly 2015."""


def oscillator_metric(x):
    """P of the oscillator of unknown frequency at x (..., 3)."""
    return np.array(jnp.vectorize(analytic_metric(2.0), signature="(n)->(n,n)")(x))


def axes_of(low, high, counts):
    return tuple(np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True))


def grid_points(axes):
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def made(count) -> Interpolated:
    axes = axes_of(LOW, HIGH, (count,) * 3)
    return Interpolated(axes, oscillator_metric(grid_points(axes)))


@jax.jit
def at(field, x):
    """The field at points (k, n)."""
    return jax.vmap(field)(x)


@pytest.fixture(scope="module")
def field():
    return made(9)


def test_exact_at_grid_points_the_last_ones_too():
    rng = np.random.default_rng(0)
    for _ in range(20):  # ends whose steps do not add up to the last point exactly
        low = rng.uniform(-1, 1, 3)
        axes = axes_of(low, low + rng.uniform(0.1, 10, 3), (5, 4, 6))
        points = grid_points(axes).reshape(-1, 3)
        values = oscillator_metric(grid_points(axes_of(LOW, HIGH, (5, 4, 6))))
        found = at(Interpolated(axes, values), points)
        np.testing.assert_allclose(found, values.reshape(-1, 3, 3), rtol=0, atol=1e-14)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    decades=st.lists(st.floats(-12, 12), min_size=3, max_size=3),
    roughness=st.floats(0.1, 1.5),
)
def test_symmetric_positive_definite_between_any_points_in_any_units(seed, decades, roughness):
    rng = np.random.default_rng(seed)
    axes = axes_of(LOW, HIGH, (5, 4, 6))
    half = np.eye(3) + roughness * rng.normal(size=(5, 4, 6, 3, 3)) / 3
    # As positive definite as doubles can tell for sure, whatever the random numbers.
    plain = half @ np.swapaxes(half, -1, -2) + 0.02 * np.eye(3)
    units = 10.0 ** np.array(decades)
    x = rng.uniform(LOW, HIGH, (200, 3))
    p = np.asarray(at(Interpolated(axes, plain * units[:, None] * units), x))
    np.testing.assert_array_equal(p, np.swapaxes(p, -1, -2))
    assert np.linalg.eigvalsh(p / (units[:, None] * units)).min() > 0
    # Other units of the coordinates give the same field.
    same = np.asarray(at(Interpolated(axes, plain), x))
    np.testing.assert_allclose(p / (units[:, None] * units), same, rtol=0, atol=1e-9 * np.abs(same).max())


LINE = np.linspace(0.0, 1.0, 5)
PLAIN = np.broadcast_to(np.eye(2), (5, 5, 2, 2)).copy()


def changed(matrix):
    values = PLAIN.copy()
    values[1, 2] = matrix
    return values


@pytest.mark.parametrize(
    ("axes", "values", "named"),
    [
        ((LINE, LINE[:4]), PLAIN, r"shape \(5, 4, 2, 2\) on this grid of 2 axes; got \(5, 5, 2, 2\)"),
        ((LINE, LINE[:3]), PLAIN[:, :3], "axis 2 needs at least four points to interpolate between; it has 3"),
        ((LINE, LINE[:1]), PLAIN[:, :1], "axis 2 needs at least four points to interpolate between; it has 1"),
        ((LINE**2, LINE), PLAIN, "axis 1 must have equal steps upward; they are 0.0625 to 0.4375"),
        ((LINE, LINE[::-1]), PLAIN, "axis 2 must have equal steps upward; they are -0.25 to -0.25"),
        ((LINE, LINE * np.nan), PLAIN, "axis 2 must have equal steps upward; they are nan to nan"),
        ((LINE, LINE), PLAIN * np.nan, "no metric at any point"),
        ((LINE, LINE), changed([[1, 2], [2, 1]]), r"at \(0.25, 0.5\) is not positive definite: 1 2; 2 1"),
        ((LINE, LINE), changed([[0, 0], [0, 1]]), r"at \(0.25, 0.5\) is not positive definite: 0 0; 0 1"),
        ((LINE, LINE), changed(np.diag([1e-9, -1e-30])), "not positive definite: 1e-09 0; 0 -1e-30"),
        ((LINE, LINE), changed([[1, 0.1], [0, 1]]), r"at \(0.25, 0.5\) is not symmetric: 1 0.1; 0 1"),
        ((LINE, LINE), changed([[1e-12, 2e-9], [1e-9, 1]]), "is not symmetric: 1e-12 2e-09; 1e-09 1"),
    ],
)
def test_what_is_no_metric_is_refused(axes, values, named):
    with pytest.raises(ValueError, match=named) as refusal:
        Interpolated(axes, values)
    assert "\n" not in str(refusal.value)


def test_a_point_of_another_dimension_is_refused(field):
    with pytest.raises(ValueError, match=r"a function of 3 coordinates; x has shape \(1,\)"):
        field(jnp.ones(1))
