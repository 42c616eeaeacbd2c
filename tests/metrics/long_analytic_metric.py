"""What takes long of `test_analytic_metric.py`."""

import jax.numpy as jnp
import pytest
from test_analytic_metric import GRID, MODEL, RATES, over_rates

from covariant.metrics import Equation, metric_at, metric_through, spd_distance
from covariant.papers.sanfelice_praly import analytic_metric, quadrature
from covariant.signals import StepCode

SOME = GRID[::9]


@over_rates
def one_pass(x, rate):
    found = metric_at(MODEL, Equation(rate), x, tolerance=1e-12)
    return spd_distance(analytic_metric(rate)(x), found.metric), found.result


@over_rates
def gramian_distance(x, rate):
    return spd_distance(analytic_metric(rate)(x), quadrature(x, rate, 40 / rate))


@over_rates
def two_passes(x, rate):
    exact, ends = analytic_metric(rate)(x), []
    for route in ("riccati", "radon"):
        passage = metric_through(MODEL, Equation(rate), x, 40 / rate, 600, start=5.0, route=route)
        ends.append(spd_distance(exact, passage.metric[-1]))
    return jnp.stack(ends)


@pytest.mark.exhaustive
def test_one_pass_backward_gives_the_printed_metric_on_the_whole_grid():
    distances, result = one_pass(jnp.asarray(GRID), jnp.asarray(RATES))
    assert (result == StepCode.OK).all()
    assert distances.max() < 1e-8


@pytest.mark.exhaustive
def test_the_weighted_gramian_is_the_printed_metric_on_the_whole_grid():
    assert gramian_distance(jnp.asarray(GRID), jnp.asarray(RATES)).max() < 1e-8


@pytest.mark.exhaustive
def test_two_passes_with_the_riccati_equation_and_with_radons_pair_give_the_printed_metric():
    assert two_passes(jnp.asarray(SOME), jnp.asarray(RATES)).max() < 1e-8
