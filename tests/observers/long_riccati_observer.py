"""What takes long of `test_riccati_observer.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg
from test_riccati_observer import (
    KALMAN,
    LAW,
    LINEAR,
    MEASUREMENT,
    NONE,
    OSCILLATOR,
    PLANT,
    PROCESS,
    SEEN,
    ZERO,
    X,
    Y,
    alone,
    constant,
    follow,
    one_step,
)

from covariant import geometry, models
from covariant._integrate import rk8
from covariant.geometry._functions import norm
from covariant.metrics import Equation, RiccatiMetric
from covariant.models import StateSpace
from covariant.observers import Estimate, InformationEKF, Riccati, run
from covariant.papers import sanfelice_praly
from covariant.papers.sanfelice_praly import analytic_metric
from covariant.signals import Record, StepCode
from covariant.simulation import observe

POINTS = jnp.asarray(sanfelice_praly.grid())


@jax.jit
def spectrum(x, rate, gain):
    """Eigenvalues of L_F P relative to P for the observer's field F(x̂) = f − 2 k_E P⁻¹ dhᵀ (h − y) at y = h(x̂)."""
    metric = analytic_metric(rate)
    observer = Riccati(OSCILLATOR, metric, x, gain)

    def field(z):
        return observer.flow(ZERO, Estimate(z, ZERO), NONE, x[:1]).x

    p, along = jax.jvp(metric, (x,), (field(x),))
    bent = p @ jax.jacfwd(field)(x)
    half = jnp.linalg.inv(jnp.linalg.cholesky(p))
    return jnp.linalg.eigvalsh(half @ (along + bent + bent.T) @ half.T)


rates_of_all = jax.jit(jax.vmap(spectrum, (0, None, None)))


@pytest.mark.parametrize("rate", [1.0, 2.0, 4.0])
def test_a_gain_of_one_quarter_contracts_every_direction_at_the_rate(rate):
    """(15) gives dhᵀdh − λP, the correction −4 k_E dhᵀdh: for ¼ nothing is left but −λP."""
    found = rates_of_all(POINTS, jnp.asarray(rate), jnp.asarray(0.25))
    np.testing.assert_allclose(found, -rate, rtol=1e-7)


def test_less_gain_loses_the_rate_and_more_never_does():
    least = rates_of_all(POINTS, jnp.asarray(2.0), jnp.asarray(0.2))[:, -1]
    assert least.max() > -0.95
    for gain in (0.25, 0.3, 0.5, 2.0, 50.0):
        assert rates_of_all(POINTS, jnp.asarray(2.0), jnp.asarray(gain)).max() < -2.0 * (1 - 1e-6)


@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_the_distance_decays_at_half_the_rate(rate):
    """From so small an error that its length in the metric at its middle is the distance to six digits."""
    t = np.linspace(0.0, 10.0, 51)
    error = 1e-5 * jnp.array([1.0, -1.0, 2.0])
    distance = observed(jnp.asarray(rate), error, jnp.asarray(t))
    assert sanfelice_praly.fitted_rate(t, np.asarray(distance)) == pytest.approx(rate / 2, rel=0.01)
    np.testing.assert_allclose(distance, distance[0] * np.exp(-rate / 2 * t), rtol=1e-3)


@jax.jit
def observed(rate, error, t):
    metric, x0 = analytic_metric(rate), jnp.array([1.0, 0.0, 1.0])
    start = Estimate(x0 + error, ZERO)
    x, state = observe(OSCILLATOR, Riccati(OSCILLATOR, metric, start.x), x0, start, t, rtol=1e-12, atol=1e-15)
    return jax.vmap(lambda a, b: norm(metric, (a + b) / 2, a - b))(x, state.x)


def test_with_a_gain_of_one_half_it_is_the_stationary_kalman_filter():
    metric = RiccatiMetric(PLANT, LAW, 40.0, 2000, start=1.0)
    observer = Riccati(PLANT, metric, jnp.asarray(X), 0.5, jnp.asarray(MEASUREMENT))
    slope = jax.jit(lambda y: observer.flow(ZERO, Estimate(jnp.asarray(X), ZERO), NONE, y).x)
    found = jax.jacfwd(slope)(jnp.asarray(Y))
    np.testing.assert_allclose(found, KALMAN, rtol=0, atol=1e-6)
    np.testing.assert_allclose(slope(jnp.asarray(Y)), LINEAR @ X + KALMAN @ (Y - SEEN @ X), rtol=0, atol=1e-6)


@pytest.mark.exhaustive
def test_the_information_filter_takes_as_many_steps_as_its_equation_needs():
    """Knowing the start well makes the equation of P stiff; one step of Runge and Kutta is far off there."""
    known = jnp.asarray(300 * np.linalg.inv(PROCESS))
    y = jnp.asarray(np.stack([np.sin(3 * np.arange(1, 11) / 50), np.cos(2 * np.arange(1, 11) / 50)], axis=1))

    def information(substeps):
        ekf = InformationEKF(PLANT, LAW, jnp.asarray(X), known, substeps=substeps)
        return np.asarray(follow(ekf, ekf.init(y[0]), y, jnp.asarray(1 / 50))[0].information[-1])

    exact = information(2000)
    np.testing.assert_allclose(information(None), exact, rtol=0, atol=1e-2 * np.abs(exact).max())
    assert not np.abs(information(1) - exact).max() <= 0.3 * np.abs(exact).max()


@pytest.mark.exhaustive
def test_the_information_filter_is_the_textbooks_to_first_order_in_the_step():
    """The discrete filter with exact discretisation of the motion, R/dt and Q dt for one step of dt."""
    ends = {}
    for steps in (40, 80, 160):
        dt = 1.0 / steps
        t = dt * np.arange(1, steps + 1)
        y = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
        ekf = InformationEKF(PLANT, LAW, jnp.asarray(X), jnp.asarray(np.linalg.inv(PROCESS)), substeps=4)
        states, _ = follow(ekf, ekf.init(jnp.asarray(y[0])), jnp.asarray(y), jnp.asarray(dt))
        x, cov, move = X, PROCESS, linalg.expm(LINEAR * dt)
        for sample in y:
            x, cov = move @ x, move @ cov @ move.T + PROCESS * dt
            gain = cov @ SEEN.T @ np.linalg.inv(SEEN @ cov @ SEEN.T + MEASUREMENT / dt)
            x, cov = x + gain @ (sample - SEEN @ x), cov - gain @ SEEN @ cov
        ends[steps] = np.abs(states.x[-1] - x).max(), np.abs(np.linalg.inv(states.information[-1]) - cov).max()
    errors = np.array(list(ends.values()))
    assert errors[-1].max() < 2e-3
    assert (errors[1:] < 0.6 * errors[:-1]).all()


@pytest.mark.exhaustive
def test_a_sampled_step_is_the_flow_to_first_order():
    observer = Riccati(OSCILLATOR, analytic_metric(2.0), jnp.array([0.8, 0.3, 1.5]), 0.25)
    steps, errors = (50, 100, 200, 400), []

    @jax.jit
    def exact(x):
        def flow(t, s):
            return observer.flow(t, s, NONE, jnp.cos(t)[None])

        return rk8(flow, ZERO, Estimate(x, ZERO), jnp.asarray(2.0), 400).x

    right = exact(observer.start)
    for count in steps:
        t = 2.0 / count * np.arange(1, count + 1)
        states, _ = follow(observer, observer.init(NONE), jnp.asarray(np.cos(t)[:, None]), jnp.asarray(2.0 / count))
        errors.append(np.abs(states.x[-1] - right).max())
    assert -1.15 < np.polyfit(np.log(steps), np.log(errors), 1)[0] < -0.85


def test_without_a_measurement_the_model_runs_on():
    for observer in (
        Riccati(PLANT, constant, jnp.asarray(X), 0.5, jnp.asarray(MEASUREMENT)),
        Riccati(OSCILLATOR, analytic_metric(2.0), jnp.array([0.8, 0.3, 1.5])),
    ):
        y = jnp.full(len(observer.model.outputs), jnp.nan)
        x, info = one_step(observer, y)
        assert info.result == StepCode.COASTED
        np.testing.assert_allclose(x, alone(observer.model, observer.start), rtol=1e-8)
        np.testing.assert_array_equal(info.innovation, 0.0)
        assert info.distance == 0.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("missing", [0, 1])
def test_a_missing_output_is_as_if_it_were_not_there(missing):
    """Whatever its noise had in common with that of the other."""
    kept = 1 - missing
    less = StateSpace(
        PLANT.f, lambda t, x, u: PLANT.h(t, x, u)[kept : kept + 1], coordinates=PLANT.coordinates, outputs=("one",)
    )
    cov, part = jnp.asarray(MEASUREMENT), jnp.asarray(MEASUREMENT[kept : kept + 1, kept : kept + 1])
    y = jnp.asarray(Y).at[missing].set(jnp.nan)
    one, info = one_step(Riccati(PLANT, constant, jnp.asarray(X), 0.5, cov), y)
    other, _ = one_step(Riccati(less, constant, jnp.asarray(X), 0.5, part), jnp.asarray(Y[kept : kept + 1]))
    np.testing.assert_allclose(one, other, rtol=1e-12)
    assert info.result == StepCode.OK
    assert info.innovation[missing] == 0.0

    start = jnp.asarray(X), 3 * jnp.eye(3)
    noise = jnp.asarray(PROCESS)
    filters = (
        (InformationEKF(PLANT, Equation(process_cov=noise, measurement_cov=cov), *start), y),
        (
            InformationEKF(less, Equation(process_cov=noise, measurement_cov=part), *start),
            jnp.asarray(Y[kept : kept + 1]),
        ),
    )
    steps = [eqx.filter_jit(f.step)(f.init(y), NONE, y, jnp.asarray(0.02))[0] for f, y in filters]
    flows = [eqx.filter_jit(f.flow)(ZERO, f.init(y), NONE, y) for f, y in filters]
    for pair in (steps, flows):
        for a, b in zip(*pair, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


@pytest.fixture(scope="module")
def field() -> geometry.Interpolated:
    axes = tuple(np.linspace(a, b, 17) for a, b in ((-1.3, 1.3), (-1.3, 1.3), (0.4, 1.7)))
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = jax.vmap(analytic_metric(2.0))(jnp.asarray(nodes.reshape(-1, 3)))
    # x1 = x2 = 0 has no metric: a small one stands in for it.
    ridge = 1e-3 * np.eye(3)
    return geometry.Interpolated(axes, np.asarray(values).reshape(17, 17, 17, 3, 3) + ridge)


@pytest.mark.exhaustive
def test_outside_a_field_the_model_runs_on_alone(field):
    start = jnp.array([1.5, 0.0, 1.0])
    x, info = one_step(Riccati(OSCILLATOR, field, start), jnp.array([0.9]))
    assert info.result == StepCode.OUT_OF_DOMAIN
    np.testing.assert_allclose(x, alone(OSCILLATOR, start), rtol=1e-8)
    rate = Riccati(OSCILLATOR, field, start).flow(ZERO, Estimate(start, ZERO), NONE, jnp.array([0.9])).x
    np.testing.assert_array_equal(rate, OSCILLATOR.f(ZERO, start, NONE))
    x, info = one_step(Riccati(OSCILLATOR, field, jnp.array([0.8, 0.3, 1.5])), jnp.array([0.9]))
    assert info.result == StepCode.OK
    assert x[0] > alone(OSCILLATOR, jnp.array([0.8, 0.3, 1.5]))[0]


def record(duration=6.0, dt=0.02) -> Record:
    t = dt * np.arange(round(duration / dt) + 1)
    return Record(t, np.zeros((len(t), 0)), np.cos(t)[:, None])


@pytest.mark.exhaustive
def test_however_the_metric_is_given_the_estimate_is_the_same(field):
    start = jnp.array([0.9, 0.1, 1.1])
    metrics = (analytic_metric(2.0), RiccatiMetric(OSCILLATOR, Equation(2.0), 16.0, 600), field)
    exact, computed, looked_up = (np.asarray(run(Riccati(OSCILLATOR, m, start), record()).estimate) for m in metrics)
    np.testing.assert_allclose(computed, exact, rtol=0, atol=1e-5)
    np.testing.assert_allclose(looked_up, exact, rtol=0, atol=0.1)
    assert np.abs(exact[-1] - [np.cos(6.0), -np.sin(6.0), 1.0]).max() < 0.02


def test_the_past_is_reckoned_with_the_input_of_now():
    model, u = models.duffing(), jnp.array([0.7])
    equation = Equation(process_cov=jnp.eye(2))
    observer = Riccati(model, RiccatiMetric(model, equation, 3.0, 60), jnp.array([0.4, 0.2]))
    told = Riccati(model, lambda x: RiccatiMetric(model, equation, 3.0, 60, u=u)(x), jnp.array([0.4, 0.2]))
    y, dt = jnp.array([0.5]), jnp.asarray(0.02)
    one, other = (eqx.filter_jit(o.step)(o.init(y), u, y, dt)[0].x for o in (observer, told))
    np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.exhaustive
def test_a_gap_in_the_log_winds_the_filter_up_and_not_the_observer():
    curves = sanfelice_praly.gap()
    after = curves["t"] > 25.0
    assert curves["ekf"][after].max() > 1.0
    assert curves["riccati"][after].max() < 0.1
    assert curves["ekf_least"].min() < 1e-10
    assert curves["riccati_least"].min() > 1e-3


@pytest.mark.exhaustive
def test_the_filter_uses_what_is_known_beforehand():
    errors = sanfelice_praly.prior()
    assert errors["riccati"] > 1.5 * errors["ekf"]
