"""Gramians of windows of past, and the rate that is chosen from them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import metrics, models
from covariant.metrics import _solution
from covariant.metrics._solution import gramians
from covariant.models import StateSpace

OSCILLATOR = models.unknown_frequency()
STATES = np.random.default_rng(0).uniform(*zip(*OSCILLATOR.box, strict=True), (16, 3))


@pytest.mark.exhaustive
def test_gramians_of_a_chain_are_moments():
    """For x1' = x2 the output told τ ago is x1 − τ x2."""
    chain = StateSpace(lambda t, x, u: jnp.stack([x[1], 0 * x[1]]), lambda t, x, u: x[:1], coordinates=("a", "b"))
    found = gramians(chain, jnp.array([0.3, -1.0]), 2.0, steps=4)
    for tau, gramian in zip((0.5, 1.0, 1.5, 2.0), found, strict=True):
        np.testing.assert_allclose(gramian, [[tau, -(tau**2) / 2], [-(tau**2) / 2, tau**3 / 3]], rtol=1e-12)
    np.testing.assert_allclose(_solution.gramian(chain, jnp.array([0.3, -1.0]), 2.0), found[-1], rtol=1e-12)


@pytest.mark.exhaustive
def test_the_rate_goes_with_the_clock():
    """An oscillator three times as fast, seen with a clock three times as fast, is the same one."""
    fast = STATES * np.array([1.0, 3.0, 9.0])
    slow = metrics.rate_from_gramian(OSCILLATOR, jnp.asarray(STATES), 30.0)
    assert metrics.rate_from_gramian(OSCILLATOR, jnp.asarray(fast), 10.0) == pytest.approx(3 * slow)
    assert 0.1 < slow < 1.0  # some half periods


@pytest.mark.exhaustive
def test_the_rate_gives_a_metric_that_observers_can_use():
    rate = metrics.rate_from_gramian(OSCILLATOR, jnp.asarray(STATES), 30.0)
    found = jax.jit(jax.vmap(lambda x: metrics.metric_at(OSCILLATOR, metrics.Equation(rate), x)))(jnp.asarray(STATES))
    assert (np.asarray(found.result) == 0).all()
    assert np.asarray(found.reconstructibility).min() > 0.1


@pytest.mark.exhaustive
def test_where_there_is_no_rate_it_says_so():
    with pytest.raises(ValueError, match=r"\(0, 0, 1\) is not reconstructible from any past up to 30 s"):
        metrics.rate_from_gramian(OSCILLATOR, jnp.array([[0.5, 1.0, 1.0], [0.0, 0.0, 1.0]]), 30.0)
    damped = models.duffing()
    states = np.random.default_rng(0).uniform(*zip(*damped.box, strict=True), (8, 2))
    with pytest.raises(ValueError, match="twice its rate of growth"):
        metrics.rate_from_gramian(damped, jnp.asarray(states), 10.0)
