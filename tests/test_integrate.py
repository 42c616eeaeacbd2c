"""Orders of the integrators by regression, and the accuracy of the adaptive one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant._integrate import dormand_prince, rk4, rk4_step, rk8

START, DURATION = 0.3, 2.0
STATE = {"position": jnp.array([1.0, 0.2]), "speed": jnp.array(0.5)}


def flow(t, x):
    """Nonlinear, with explicit time, over a dictionary."""
    a, b = x["position"]
    return {"position": jnp.stack([b * jnp.cos(t), -jnp.sin(a) * x["speed"]]), "speed": jnp.sin(3 * t) - a * x["speed"]}


def flat(x):
    return np.concatenate([np.asarray(x["position"]), np.asarray(x["speed"])[None]])


def test_step_is_fourth_order_in_polynomials_of_time():
    """Exact for a slope that is a cubic of time."""
    t, x, dt = (jnp.array(a) for a in (0.5, 1.0, 0.7))
    end = rk4_step(lambda t, x: 4 * t**3, t, x, dt)
    np.testing.assert_allclose(end, 1.0 + 1.2**4 - 0.5**4, rtol=1e-14)


def test_number_of_steps_may_be_traced():
    static = jax.jit(lambda x: rk4(flow, START, x, DURATION, 7))(STATE)
    traced = jax.jit(lambda x, steps: rk4(flow, START, x, DURATION, steps))(STATE, 7)
    np.testing.assert_allclose(flat(traced), flat(static), rtol=1e-13)


@pytest.mark.parametrize("rule", [rk4, rk8])
def test_back_is_the_way_there(rule):
    @jax.jit
    def return_trip(x):
        return rule(flow, START + DURATION, rule(flow, START, x, DURATION, 400), -DURATION, 400)

    np.testing.assert_allclose(flat(return_trip(STATE)), flat(STATE), atol=1e-9)


@pytest.mark.parametrize("rule", [rk4, rk8])
def test_integrators_are_differentiable(rule):
    """`x(1) = exp(−k)x(0)`."""

    def end(k):
        return rule(lambda t, x: -k * x, 0.0, jnp.array(2.0), 1.0, 50)

    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(jnp.array(0.7)), -2.0 * np.exp(-0.7), rtol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.jacrev(end))(jnp.array(0.7)), -2.0 * np.exp(-0.7), rtol=1e-7)


def test_stages_fit_their_nodes_and_integrate_polynomials():
    """A row sums to its node, and `Σ b c^(k−1) = 1/k` to order 8."""
    a, b, c = dormand_prince()
    np.testing.assert_allclose(a.sum(axis=1), c, rtol=0, atol=1e-14)
    for k in range(1, 9):
        assert b @ c ** (k - 1) == pytest.approx(1 / k, abs=1e-14)
