"""What takes long of `test_premises.py`."""

import jax.numpy as jnp
import pytest
from test_premises import OVERFLOWS, REGION, STILL, WIDE, pushed, rubbed

from covariant.certificates import certify, decay
from covariant.certificates.base import in_coordinates


@pytest.mark.parametrize("name", ["a product with nought", "is it finite", "a cosh"])
def test_where_it_does_stay_finite_it_is_proved(name):
    found = certify(rubbed(OVERFLOWS[name]), **WIDE | {"position": (-0.1, 0.1)})
    assert found.statement.proved


def test_with_times_it_is_certified_over_them_and_without_time_none_are_needed():
    timed = certify(pushed(lambda t, q, u: u + jnp.sin(t)), times=(0.0, 2.0), **REGION)
    assert timed.statement.verdict == "holds"
    assert timed.given.times.tolist() == [0.0, 2.0]
    assert timed.domain.high[-1] >= 1.0  # the largest force
    assert certify(pushed(lambda t, q, u: u), **REGION).statement.verdict == "holds"


def test_decay_holds_where_the_premises_do_and_fails_at_a_larger_rate():
    pairs = jnp.array([[1.0]]), jnp.array([[2.0]]), jnp.linspace(0.0, 1.0, 5)
    assert decay(*STILL, 2.0, *pairs).holds
    assert not decay(*STILL, 2.5, *pairs).holds


EXPANDING = {
    "a distance without a lower bound": (
        lambda t, x: jnp.stack([-x[0], x[1]]),
        lambda t, x: jnp.diag(jnp.stack([1.0, 1 / (1 + x[1] ** 2)])),
        [[0.0, 0.0]],
        [[1.0, 3.0]],
    ),
    "a wavy metric": (lambda t, x: x, lambda t, x: (1 + 0.9 * jnp.sin(60 * x))[None], [[0.0]], [[1.0]]),
}


@pytest.mark.exhaustive("a distance without a lower bound")
@pytest.mark.parametrize("name", EXPANDING)
def test_decay_does_not_hold_for_want_of_a_lower_bound(name):
    flow, form, x0, x1 = EXPANDING[name]
    found = decay(flow, in_coordinates(form), 1.0, jnp.asarray(x0), jnp.asarray(x1), jnp.linspace(0.0, 2.0, 3))
    assert found.statement.verdict == "undecided"


@pytest.mark.exhaustive
def test_decay_needs_a_metric_and_is_not_refuted_by_rounding():
    pairs = jnp.zeros((1, 2)), jnp.ones((1, 2)), jnp.linspace(0.0, 1.0, 3)
    with pytest.raises(ValueError, match="the metric is not positive definite along pair 1"):
        decay(lambda t, x: -x, in_coordinates(lambda t, x: jnp.diag(jnp.array([1.0, 0.0]))), 1.0, *pairs)
    quick = decay(lambda t, x: -1000 * x, in_coordinates(lambda t, x: jnp.eye(2)), 1500.0, *pairs[:2], 2 * pairs[2])
    assert quick.holds
