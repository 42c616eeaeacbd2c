"""Orders of the integrators by regression, and the accuracy of the adaptive one: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_integrate import DURATION, START, STATE, flat, flow

from covariant._adaptive import solve, solve_until
from covariant._integrate import linearised, rk4, rk4_step, rk8


@pytest.fixture(scope="module")
def exact():
    return flat(jax.jit(lambda x: rk8(flow, START, x, DURATION, 2000))(STATE))


@pytest.mark.parametrize(
    ("rule", "order", "steps"), [(rk4, 4, (16, 24, 32, 48, 64)), (rk8, 8, (6, 8, 12, 16))], ids=["rk4", "rk8"]
)
def test_order(exact, rule, order, steps):
    errors = []
    for count in steps:
        end = jax.jit(lambda x, count=count: rule(flow, START, x, DURATION, count))(STATE)
        errors.append(np.abs(flat(end) - exact).max())
    assert -np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(order, abs=0.4)


@pytest.mark.parametrize("rule", [rk4, rk8])
def test_single_precision_stays_single(rule):
    x = jax.ShapeDtypeStruct((2,), jnp.float32)
    assert jax.eval_shape(lambda x: rule(lambda t, x: -x, 0.0, x, 1.0, 4), x).dtype == jnp.float32


@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
def test_solve_reaches_its_tolerance(exact, tolerance):
    """At uneven stamps, the first of them the start; errors may add up to a hundred times the tolerance of a step."""
    times = START + DURATION * jnp.array([0.0, 0.1, 0.15, 0.8, 1.0])
    run = jax.jit(lambda x: solve(flow, x, times, rtol=tolerance, atol=tolerance))(STATE)
    assert run["position"].shape == (5, 2)
    np.testing.assert_array_equal(run["position"][0], STATE["position"])
    np.testing.assert_allclose(flat(jax.tree.map(lambda a: a[-1], run)), exact, rtol=0, atol=100 * tolerance)


def test_solution_that_escapes_is_infinite():
    """`x' = x²` from 1 reaches infinity at t = 1."""
    times = jnp.array([0.0, 0.5, 2.0])
    run = jax.jit(lambda x: solve(lambda t, x: x**2, x, times, max_steps=2000))(jnp.array(1.0))
    np.testing.assert_allclose(run[:2], [1.0, 2.0], rtol=1e-9)
    assert not np.isfinite(run[2])


def test_an_escape_takes_few_steps():
    """Also where its last steps are a few roundings of the time long; evaluations are counted, of at most 70 000."""
    calls = []

    def counted(t, x):
        jax.debug.callback(lambda: calls.append(1))
        return x**2

    times = jnp.array([0.0, 2.0, 3.0])
    jax.block_until_ready(jax.jit(lambda x: solve(counted, x, times, max_steps=5000))(jnp.array(1.0)))
    assert len(calls) < 10_000


def test_a_program_that_solves_can_be_stored():
    """JAX stores no program that calls back to the host."""

    def until(x):
        return solve_until(flow, x, lambda x: x["speed"] > 9, lambda x: x["speed"], rtol=1e-9, atol=1e-9, max_steps=9)

    for program in (jax.jit(lambda x: solve(flow, x, jnp.array([0.0, 1.0]))), jax.jit(until)):
        assert "callback" not in program.lower(STATE).as_text()


@pytest.mark.exhaustive
def test_solve_goes_back_in_time_and_is_differentiable(exact):
    times = jnp.array([START + DURATION, 1.0, START])
    there = jax.tree.map(lambda a, b: jnp.reshape(a, jnp.shape(b)), {"position": exact[:2], "speed": exact[2]}, STATE)
    back = jax.jit(lambda x: solve(flow, x, times))(there)
    np.testing.assert_allclose(flat(jax.tree.map(lambda a: a[-1], back)), flat(STATE), rtol=0, atol=1e-8)

    def end(k):
        return solve(lambda t, x: -k * x, jnp.array(2.0), jnp.array([0.0, 1.0]))[-1]

    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(jnp.array(0.7)), -2.0 * np.exp(-0.7), rtol=1e-9)


@pytest.mark.exhaustive
def test_steps_end_where_a_condition_or_a_border_says():
    """A falling stone: after the first step below half its height, and where it meets the ground, each in a batch."""

    def fall(height, border):
        start = jnp.stack([height, jnp.zeros(())])
        low = height / 2 if border is None else -jnp.inf
        return solve_until(
            lambda t, x: jnp.stack([x[1], -9.81]),
            start,
            lambda x: x[0] < low,
            border,
            rtol=1e-9,
            atol=1e-12,
            max_steps=100,
        )

    heights = jnp.array([0.5, 3.0, 40.0])
    t, x = jax.jit(jax.vmap(lambda h: fall(h, lambda x: x[0])))(heights)
    np.testing.assert_allclose(t, np.sqrt(2 * heights / 9.81), rtol=1e-11)
    np.testing.assert_allclose(x[:, 0], 0.0, atol=1e-10)
    t, x = jax.jit(jax.vmap(lambda h: fall(h, None)))(heights)
    np.testing.assert_allclose(x[:, 0], heights - 9.81 * t**2 / 2, rtol=1e-9)
    assert np.all(x[:, 0] < heights / 2)


def test_a_single_precision_solution_stays_single_and_may_be_one_number():
    times = jnp.array([0.0, 0.5, 1.0], jnp.float32)
    run = jax.jit(lambda x: solve(lambda t, x: -x, x, times, rtol=1e-5, atol=1e-6))(jnp.ones((), jnp.float32))
    assert run.shape == (3,)
    assert run.dtype == jnp.float32
    np.testing.assert_allclose(run, np.exp(-times), rtol=1e-4)


def test_nothing_finite_is_made_of_a_slope_that_is_not():
    run = jax.jit(lambda x: solve(lambda t, x: x * jnp.nan, x, jnp.array([0.0, 1.0])))(jnp.ones(2))
    assert np.all(np.isinf(run[1]))


def test_a_step_of_the_equation_of_variation_has_the_derivative_of_the_step():
    def flow(t, x):
        return jnp.stack([x[1] * x[2], jnp.sin(t) - jnp.cos(x[0]) * x[1], 0.0 * x[2]])

    x, into = jnp.array([0.3, -0.7, 1.2]), jnp.array([[1.0, 0.2], [0.0, 1.0], [0.5, 0.0]])
    end, slope = rk4_step(linearised(flow), 0.4, (x, into), 0.3)
    np.testing.assert_allclose(end, rk4_step(flow, 0.4, x, 0.3), rtol=1e-15)
    np.testing.assert_allclose(slope, jax.jacfwd(lambda x: rk4_step(flow, 0.4, x, 0.3))(x) @ into, rtol=1e-13)
