"""What there is no metric for, and what the answer then says; and the small functions beside the equation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.metrics import Equation, high_gain, metric_at, metric_through, spd_distance
from covariant.metrics._solution import reconstructibility
from covariant.metrics._window import Window
from covariant.models import StateSpace

OSCILLATOR = models.unknown_frequency()
OTHER = StateSpace(  # the oscillator of van der Pol
    lambda t, x, u: jnp.stack([x[1], (1 - x[0] ** 2) * x[1] - x[0]]), lambda t, x, u: x[:1], coordinates=("q", "v")
)


def test_a_window_that_tells_nothing_to_rounding_bounds_nothing():
    """What it tells, and what the noise stirs, must be more than rounding in every direction."""
    one, lost, x = jnp.eye(2), jnp.diag(jnp.array([1.0, -1e-17])), jnp.zeros(2)
    assert Window(x, one, one, one).error_bound(1.0) == 2.0
    for information, spread in ((lost, one), (one, lost), (lost, lost), (lost, None)):
        assert np.isnan(Window(x, one, information, spread).error_bound(1.0))


@pytest.mark.parametrize("x", [jnp.zeros(2), jnp.zeros((2, 3)), jnp.zeros(4)])
def test_a_state_of_the_wrong_size_is_refused(x):
    if x.ndim == 1:
        with pytest.raises(ValueError, match=r"x must be a state \(3,\); it has shape"):
            metric_at(OSCILLATOR, Equation(1.0), x)
    with pytest.raises((ValueError, TypeError)):
        metric_through(OSCILLATOR, Equation(1.0), x, 1.0, 2)


@pytest.mark.parametrize("arguments", [{}, {"rate": -1.0}, {"rate": float("nan")}, {"rate": float("inf")}])
def test_an_equation_without_rate_and_noise_is_refused(arguments):
    with pytest.raises(ValueError, match="rate") as caught:
        Equation(**arguments)
    assert "\n" not in str(caught.value)


distance = jax.jit(spd_distance)


@pytest.mark.parametrize("wrong", [np.diag([1.0, -1.0]), np.diag([1.0, 0.0]), np.full((2, 2), np.nan)])
def test_distance_of_what_is_no_metric_is_nan(wrong):
    assert np.isnan(distance(np.eye(2), wrong))
    assert np.isnan(distance(wrong, np.eye(2)))


def test_reconstructibility_is_one_for_independent_and_zero_for_unseen_directions():
    at = jax.jit(reconstructibility)
    assert at(jnp.diag(jnp.array([1e-9, 1.0, 1e9]))) == pytest.approx(1.0, rel=1e-12)
    assert at(jnp.array([[1.0, 0.6], [0.6, 1.0]])) == pytest.approx(0.4, rel=1e-12)
    assert at(jnp.array([[1.0, 2.0], [2.0, 4.0]])) == pytest.approx(0.0, abs=1e-15)
    assert at(jnp.diag(jnp.array([1.0, 0.0]))) == 0.0
    assert np.isnan(at(jnp.full((2, 2), jnp.nan)))


def chain(n, extra=lambda x: 0.0 * x[0]):
    """n integrators in a row, the first of which is seen, with something that acts on the last."""
    return StateSpace(
        lambda t, x, u: jnp.concatenate([x[1:], extra(x)[None]]),
        lambda t, x, u: x[:1],
        coordinates=tuple(f"x{k}" for k in range(n)),
    )


def test_high_gain_passes_through_the_derivatives_of_the_output():
    """A chain in other coordinates: the metric is the chain's, carried back by the map to the derivatives of y."""
    bent = StateSpace(
        lambda t, x, u: jnp.stack([x[1] + x[0] ** 2, -2 * x[0] * (x[1] + x[0] ** 2)]),
        lambda t, x, u: x[:1],
        coordinates=("a", "b"),
    )
    x = jnp.array([0.4, -0.7])
    j = jnp.array([[1.0, 0.0], [2 * x[0], 1.0]])
    expected = j.T @ high_gain(chain(2), 2.0)(x) @ j
    np.testing.assert_allclose(high_gain(bent, 2.0)(x), expected, rtol=1e-12)


def test_high_gain_is_for_one_output():
    two = StateSpace(lambda t, x, u: x, lambda t, x, u: x, coordinates=("a", "b"), outputs=("left", "right"))
    with pytest.raises(ValueError, match="one output; the model has 2: left, right"):
        high_gain(two, 1.0)
