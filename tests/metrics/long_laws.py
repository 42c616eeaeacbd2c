"""What takes long of `test_laws.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_laws import AT_REST, CASES, SHARES, STEP, TIME, distances, found, stationary_information, windows

from covariant.metrics import Equation, metric_at, metric_through
from covariant.metrics._window import window_at
from covariant.signals import StepCode


@eqx.filter_jit
def passages(model, x, u, length, start, process_cov, measurement_cov):
    equation = Equation(process_cov=process_cov, measurement_cov=measurement_cov)
    through = jax.vmap(lambda start: metric_through(model, equation, x, length, 400, start=start, u=u))
    return through(start)


@pytest.mark.exhaustive
def test_solutions_are_found_and_are_metrics(found):
    for name, answer in found.answers.items():
        assert (answer.solution.result == StepCode.OK).all(), name
        assert (answer.solution.error_bound < found.case.tolerance).all(), name
        assert np.linalg.eigvalsh(answer.metric).min() > 0, name
        np.testing.assert_allclose(answer.metric, answer.metric.swapaxes(1, 2), rtol=1e-10)


@pytest.mark.exhaustive
def test_the_equation_is_satisfied_along_the_motion(found):
    """Ṗ by finite differences of solutions at states on the motion's tangent, against the terms of (8), whitened."""
    case, p = found.case, found.answers["itself"].metric
    h = STEP * case.span
    slope = [found.answers[f"{k:+d}"].metric for k in (-2, -1, 1, 2)]
    slope = (8 * (slope[2] - slope[1]) - (slope[3] - slope[0])) / (12 * h)
    for k, x in enumerate(case.x):
        a, c = (np.asarray(j) for j in case.model.jacobians(TIME, jnp.asarray(x), jnp.asarray(case.u)))
        gathered = c.T @ np.linalg.solve(case.measurement_cov, c)
        quadratic = p[k] @ case.process_cov @ p[k]
        residual = slope[k] + p[k] @ a + a.T @ p[k] - gathered + quadratic
        half = np.linalg.inv(np.linalg.cholesky(p[k]))
        scale = np.abs(half @ quadratic @ half.T).max()
        assert np.abs(half @ residual @ half.T).max() < 1e-4 * scale
        assert np.abs(half @ slope[k] @ half.T).max() > 5e-4 * scale  # or the law would say nothing of it


@pytest.mark.exhaustive
def test_how_it_was_started_is_forgotten_and_it_is_a_tensor(found):
    itself = found.answers["itself"]
    for name in ("low start", "high start"):
        other = found.answers[name]
        bound = itself.solution.error_bound + other.solution.error_bound
        assert (distances(itself.metric, other.metric) <= bound).all(), name
    for name in ("cubic chart", "other units", "louder output"):
        assert distances(itself.metric, found.answers[name].metric).max() < 3 * found.case.tolerance, name


@pytest.mark.exhaustive("unknown frequency", "van der Pol", "Lorenz", "bioreactor", "induction motor")
def test_units_change_no_code_and_no_index(found):
    itself, scaled = found.answers["itself"].solution, found.answers["other units"].solution
    np.testing.assert_array_equal(itself.result, scaled.result)
    np.testing.assert_allclose(itself.reconstructibility, scaled.reconstructibility, rtol=1e-6)
    np.testing.assert_allclose(itself.horizon, scaled.horizon, rtol=0.1)


@jax.jit
def weigh(windows, starts):
    every = jax.vmap(lambda window: (window.error_bound(1.0), jax.vmap(window.metric)(starts)))
    return jax.vmap(every)(windows)


@pytest.mark.exhaustive
def test_the_error_bound_holds_what_the_unknown_past_can_change(found):
    """From above for every start, and from below: some start is as wrong as half of it."""
    case, n = found.case, len(found.case.size)
    starts = np.array([1e-9, 1e-3, 1.0, 1e3, 1e12])[:, None, None] * np.diag(1 / case.size**2)
    error_bounds, metrics = (np.asarray(part) for part in weigh(found.windows, starts))
    errors = distances(found.answers["itself"].metric[:, None, None], metrics)
    assert (errors <= error_bounds[..., None] * (1 + 1e-6) + 3 * case.tolerance).all()
    clear = (error_bounds > 30 * case.tolerance) & (error_bounds < 0.3)
    assert clear.any()
    assert (errors.max(-1)[clear] > error_bounds[clear] / (2.5 * np.sqrt(n))).all()


PAIRS = 170
"""Random pairs of metrics for each of the six models: together more than a thousand."""


def random_starts(metric, count, seed=6):
    """Random metrics within a factor of ten of the given one, in every direction."""
    n, rng = len(metric), np.random.default_rng(seed)
    turned = np.linalg.qr(rng.normal(size=(count, n, n)))[0]
    half = np.linalg.cholesky(metric) @ turned
    return half * 10.0 ** rng.uniform(-1, 1, (count, 1, n)) @ half.swapaxes(1, 2)


def fly(case, x, u, length, start):
    noise = jnp.asarray(case.process_cov), jnp.asarray(case.measurement_cov)
    return passages(case.model, jnp.asarray(x), jnp.asarray(u), jnp.asarray(length), jnp.asarray(start), *noise)


@pytest.mark.exhaustive("Lorenz", "induction motor", "unknown frequency", "van der Pol")
def test_the_flow_contracts_the_distance_of_any_two_metrics(found):
    """Lemma 4.2 with its own constants at every instant: D' ≤ −q p D, q and p the least eigenvalues of Q and of both
    metrics, in coordinates in which Q is the identity."""
    case = found.case
    start = random_starts(found.answers["earlier"].metric[0], 2 * PAIRS)
    passage = fly(case, case.x[0], case.u, case.span * SHARES[0], start)
    n, every = len(case.size), 20
    metrics = np.asarray(passage.metric)[:, ::every]
    d = distances(*metrics.reshape(2, PAIRS, -1, n, n))
    assert (np.diff(d, axis=1) <= 1e-9).all()
    assert (d[:, -1] < d[:, 0]).all()
    half = np.linalg.cholesky(case.process_cov)
    least = np.linalg.eigvalsh(half.T @ metrics @ half)[..., 0].reshape(2, PAIRS, -1).min(0)
    t = np.asarray(passage.t)[0, ::every]
    slower = np.minimum(least[:, :-1], least[:, 1:]) * np.diff(t)
    assert (np.diff(np.log(d), axis=1) <= -0.9 * slower + 1e-6).all()


@pytest.mark.exhaustive("Lorenz", "van der Pol")
@pytest.mark.parametrize("found", AT_REST, indirect=True)
def test_it_is_approached_geometrically_in_the_number_of_windows(found):
    """Remark 4.5, at rest: each window takes away what the slowest pole of the stationary filter does."""
    case = found.case
    exact, closed = stationary_information(case)
    slowest = max(np.linalg.eigvals(closed), key=lambda pole: (pole.real, pole.imag))
    # After half a turn of the slowest pair of poles the difference has only shrunk.
    least = np.log(1e7) / -2 / slowest.real
    window = (
        least / 10 if slowest.imag == 0 else np.pi / slowest.imag * max(1, round(least / 10 * slowest.imag / np.pi))
    )
    count = max(3, round(least / window))
    every = 400 // count
    length = 400 / every * window
    start = random_starts(exact, 2 * PAIRS)
    passage = fly(case, case.still[0], case.still[1], length, start)
    logs = np.log(distances(exact, np.asarray(passage.metric)[:, : count * every + 1 : every]))
    late = logs[:, count // 2 :]
    assert (late < -2).all()
    np.testing.assert_allclose(np.diff(late, axis=1), 2 * slowest.real * window, rtol=0.03)


@pytest.mark.exhaustive
@pytest.mark.parametrize("tolerance", [1e-2, 1e-5])
def test_the_error_is_below_its_bound_and_that_below_the_tolerance(tolerance):
    """Each solution against one whose past is as long as nine digits need."""
    case = CASES["van der Pol"]
    states = jnp.asarray(np.random.default_rng(8).uniform(-0.9, 0.9, (40, 2)))

    @jax.jit
    def at(x):
        one = Equation(process_cov=jnp.asarray(case.process_cov))
        coarse = jax.vmap(lambda x: metric_at(case.model, one, x, start=3.0, tolerance=tolerance))(x)
        return coarse, jax.vmap(lambda x: window_at(case.model, one, x, 16.0, 1600).metric(3.0))(x)

    found, exact = at(states)
    error = distances(exact, found.metric)
    assert (found.result == StepCode.OK).all()
    assert (error <= found.error_bound + 1e-9).all()
    assert (found.error_bound < tolerance).all()
    assert error.max() > 1e-2 * tolerance  # no longer a past than needed
