"""What takes long of `test_outcomes.py`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import linalg
from test_outcomes import OSCILLATOR, OTHER, chain, distance

from covariant.metrics import (
    Equation,
    RiccatiMetric,
    high_gain,
    lie_derivative,
    metric_at,
    metric_through,
    spd_distance,
)
from covariant.metrics._solution import gramian
from covariant.models import StateSpace
from covariant.observers import Estimate, Riccati
from covariant.papers.sanfelice_praly import analytic_metric, quadrature
from covariant.signals import StepCode

ZERO, NONE = jnp.zeros(()), jnp.zeros(0)


BOX = (jnp.array([-2.0, -2.0, 0.1]), jnp.array([2.0, 2.0, 2.0]))


EQUATIONS = {"(15)": Equation(1.0), "(8)": Equation(process_cov=jnp.eye(3))}


@pytest.fixture(scope="module", params=EQUATIONS)
def answers(request):
    """States of the oscillator, each for its own reason, all in one program; and the program."""
    equation = EQUATIONS[request.param]
    at = jax.jit(jax.vmap(lambda x: metric_at(OSCILLATOR, equation, x, domain=BOX, max_steps=500)))
    states = {
        "good": [0.5, 1.2, 0.8],
        "at rest": [0.0, 0.0, 1.0],
        "outside": [3.0, 0.0, 1.0],
        "not a number": [0.5, np.nan, 1.0],
        "leaves": [1.9, 1.9, 1.0],
    }
    found = at(jnp.array(list(states.values())))
    return equation, {name: jax.tree.map(lambda leaf, k=k: leaf[k], found) for k, name in enumerate(states)}


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "result"),
    [
        ("at rest", StepCode.NOT_RECONSTRUCTIBLE),
        ("outside", StepCode.OUT_OF_DOMAIN),
        ("not a number", StepCode.NOT_FINITE),
    ],
)
def test_where_there_is_no_metric_it_is_nan_and_says_why(answers, name, result):
    found = answers[1][name]
    assert found.result == result
    assert np.isnan(found.metric).all()
    assert answers[1]["good"].result == StepCode.OK


@pytest.mark.exhaustive
def test_a_past_that_leaves_the_domain_starts_at_its_border(answers):
    equation, all_found = answers
    found = all_found["leaves"]
    assert found.result == StepCode.LEFT_DOMAIN
    passage = metric_through(OSCILLATOR, equation, jnp.array([1.9, 1.9, 1.0]), found.horizon, 200)
    assert spd_distance(passage.metric[-1], found.metric) < 1e-4
    assert jnp.abs(passage.x[0]).max() > 2.0 - 1e-5


# a' = −a³ began at infinity half a second before a = 1; b stayed where it is, and both are seen.
HALF_INFINITE = StateSpace(
    lambda t, x, u: jnp.stack([-(x[0] ** 3), 0 * x[1]]), lambda t, x, u: x, coordinates=("a", "b")
)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("model", "equation", "x", "horizon"),
    [
        (OTHER, Equation(process_cov=jnp.eye(2)), [3.0, 0.0], (1.0, 1.5)),
        (HALF_INFINITE, Equation(1.0), [1.0, 0.5], (0.4995, 0.5005)),
    ],
    ids=["outside a limit cycle", "one coordinate"],
)
def test_a_solution_that_came_from_infinity_has_escaped(model, equation, x, horizon):
    found = jax.jit(lambda x: metric_at(model, equation, x, max_steps=500))(jnp.array(x))
    assert found.result == StepCode.ESCAPED
    assert np.isfinite(found.metric).all()
    assert horizon[0] < found.horizon < horizon[1]


@pytest.mark.exhaustive
def test_the_metric_before_a_window_is_one_unless_it_is_given():
    """A past so short that its start still counts; as a number it is that many times I."""
    x = jnp.array([0.5, 1.2, 0.8])
    by_default = RiccatiMetric(OSCILLATOR, Equation(1.0), 0.3, 20)(x)
    np.testing.assert_array_equal(by_default, RiccatiMetric(OSCILLATOR, Equation(1.0), 0.3, 20, start=jnp.eye(3))(x))
    passage = metric_through(OSCILLATOR, Equation(1.0), x, 0.3, 20)
    np.testing.assert_array_equal(passage.metric[0], np.eye(3))
    np.testing.assert_allclose(by_default, passage.metric[-1], rtol=0, atol=1e-9)


def two_modes(t, x, u):
    """Eigenvalues −1 and −2: backward, the part of the output that fades fastest grows at 2."""
    return jnp.stack([x[1], -2 * x[0] - 3 * x[1]])


STABLE = StateSpace(two_modes, lambda t, x, u: x[:1], coordinates=("a", "b"))


@pytest.mark.exhaustive
def test_a_rate_that_is_too_small_does_not_settle():
    """The Gramian of a stable system needs λ above twice its fastest decay: 4; there it solves Lyapunov's equation."""
    at = jax.jit(jax.vmap(lambda rate: metric_at(STABLE, Equation(rate), jnp.zeros(2), max_steps=300), 0))
    found = at(jnp.array([1.0, 3.5, 4.5, 8.0]))
    np.testing.assert_array_equal(found.result[2:], StepCode.OK)
    assert set(found.result[:2].tolist()) <= {int(StepCode.NOT_SETTLED), int(StepCode.NOT_RECONSTRUCTIBLE)}
    a, c = np.array([[0.0, 1.0], [-2.0, -3.0]]), np.array([[1.0, 0.0]])
    for rate, metric in zip((4.5, 8.0), found.metric[2:], strict=True):
        exact = linalg.solve_continuous_lyapunov((a + rate / 2 * np.eye(2)).T, c.T @ c)
        assert spd_distance(jnp.asarray(exact), metric) < 1e-6


@pytest.mark.exhaustive
def test_single_precision_stays_single():
    x = jnp.array([0.5, 1.2, 0.8], jnp.float32)
    for equation in (Equation(2.0), Equation(2.0, process_cov=jnp.eye(3))):
        found = jax.jit(lambda x, equation=equation: metric_at(OSCILLATOR, equation, x))(x)
        assert {leaf.dtype for leaf in found[:4]} == {jnp.dtype(jnp.float32)}
        assert found.result == StepCode.OK
        assert found.error_bound < 1e-3
        if equation.process_cov is None:
            exact = analytic_metric(2.0)(x.astype(float))
            assert spd_distance(exact, found.metric.astype(float)) < 2e-3


sizes = st.integers(1, 5)


seeds = st.integers(0, 10_000)


def positive(rng, n, spread):
    q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return (q * 10.0 ** rng.uniform(-spread, spread, n)) @ q.T


@given(sizes, seeds)
def test_distance_of_badly_scaled_matrices(n, seed):
    """States in mm and km, or A and rad/s: units spread the entries over many decades, and change no distance."""
    rng = np.random.default_rng(seed)
    a, b = (positive(rng, n, 1.0) for _ in range(2))
    unit = np.diag(10.0 ** rng.integers(-8, 9, n))
    exact = np.sqrt((np.log(linalg.eigvalsh(b, a)) ** 2).sum())
    for one, other in ((a, b), (b, a)):
        assert float(distance(unit @ one @ unit, unit @ other @ unit)) == pytest.approx(exact, rel=1e-8)
    assert float(distance(a, a)) < 1e-12


@pytest.mark.exhaustive
@pytest.mark.parametrize("n", [2, 3, 4])
def test_high_gain_solves_equation_15_for_a_chain_and_puts_every_pole_at_its_rate(n):
    model, rate, x = chain(n), 3.0, jnp.linspace(0.3, 1.0, n)
    metric = high_gain(model, rate)
    p = metric(x)
    output = model.jacobians(ZERO, x, NONE)[1]
    np.testing.assert_allclose(lie_derivative(model, metric, x), output.T @ output - rate * p, rtol=0, atol=1e-11)
    observer = Riccati(model, metric, x, gain=0.5)
    slope = jax.jacfwd(lambda z: observer.flow(ZERO, Estimate(z, ZERO), NONE, x[:1]).x)(x)
    found = np.poly(np.asarray(slope))
    np.testing.assert_allclose(found, np.poly(np.full(n, -rate)), rtol=1e-9)
