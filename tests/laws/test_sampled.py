"""Observers between samples: what a step must do whatever the rate, the gaps and the friction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg, signal

from covariant import design, models, simulation
from covariant._integrate import rk4
from covariant.geometry import Budget
from covariant.observers import EKF, Copy, FilteredDerivative, Geodesic, Intrinsic, SavitzkyGolay, run
from covariant.signals import Record, Result

ALPHA, BETA = 30.0, 500.0
CHAIN = models.pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.02, 0.01))
RANDOM = np.random.default_rng(0)
STAMPS = jnp.asarray(np.cumsum(np.concatenate([[0.0], RANDOM.uniform(1e-3, 4e-3, 300)])))
OBSERVERS = {
    "intrinsic": lambda m: Intrinsic(m, ALPHA, BETA),
    "geodesic": lambda m: Geodesic(m, ALPHA, BETA),
    "copy": lambda m: Copy(m, ALPHA, BETA),
    "ekf": lambda m: EKF(m, jnp.eye(2), 1e-6 * jnp.eye(2)),
}


@pytest.fixture(scope="module")
def truth():
    """An exact record of the double pendulum at irregular stamps."""
    x0 = jnp.array([0.6, -0.4, 1.5, -2.0])
    return jax.jit(lambda: simulation.simulate(CHAIN, x0, STAMPS))()


def follow(observer, record, x0):
    """Run from a given initial state; returns estimates (T, 4) and results (T,)."""

    def step(state, sample):
        state, info = observer.step(state, *sample)
        return state, (observer.estimate(state), info.result)

    start = observer.init(record.y[0])._replace(v=x0[2:])
    samples = (record.u[:-1], record.y[1:], jnp.diff(record.t))
    return jax.lax.scan(step, start, samples)[1]


@pytest.fixture(scope="module")
def followers():
    return {name: jax.jit(lambda r, x, o=make(CHAIN): follow(o, r, x)) for name, make in OBSERVERS.items()}


@pytest.mark.parametrize("name", OBSERVERS)
def test_without_error_an_observer_stays_on_the_truth(followers, truth, name):
    estimate, result = followers[name](truth, truth.x[0])
    assert jnp.abs(estimate - truth.x[1:]).max() < 1e-7
    assert (result == Result.OK).all()


@pytest.mark.parametrize("name", OBSERVERS)
def test_an_error_dies_out(followers, truth, name):
    estimate, _ = followers[name](truth, jnp.zeros(4))
    error = jnp.linalg.norm(estimate[:, 2:] - truth.x[1:, 2:], axis=1)
    assert error[-1] < 2e-2 * error[0]


@pytest.mark.parametrize("name", OBSERVERS)
def test_a_gap_is_coasted_on_the_model(followers, truth, name):
    gap = slice(100, 160)
    y = truth.y.at[gap].set(jnp.nan)
    estimate, result = followers[name](truth._replace(y=y), truth.x[0])
    assert jnp.abs(estimate - truth.x[1:]).max() < 1e-7
    assert (np.flatnonzero(np.asarray(result) == Result.COASTED) == np.arange(99, 159)).all()


@pytest.mark.parametrize("name", OBSERVERS)
def test_one_joint_missing_now_and_then_does_no_harm(followers, truth, name):
    y = truth.y.at[1::2, 0].set(jnp.nan).at[2::3, 1].set(jnp.nan)
    estimate, result = followers[name](truth._replace(y=y), jnp.zeros(4))
    error = jnp.linalg.norm(estimate[:, 2:] - truth.x[1:, 2:], axis=1)
    assert error[-1] < 0.15 * error[0]
    assert set(np.unique(result)) == {Result.OK, Result.COASTED}


@pytest.mark.parametrize("name", OBSERVERS)
def test_turns_of_a_circle_joint_do_not_matter(followers, truth, name):
    turns = 2 * jnp.pi * jnp.asarray(RANDOM.integers(-2, 3, truth.y.shape), float)
    wrapped = truth._replace(y=truth.y + turns.at[0].set(0.0))
    plain, shifted = (followers[name](r, jnp.zeros(4))[0] for r in (truth, wrapped))
    assert jnp.abs(plain - shifted).max() < 1e-9


@pytest.mark.parametrize(
    "make", [OBSERVERS["intrinsic"], OBSERVERS["copy"], lambda m: Geodesic(m, 30.0, 500.0, Budget(2, 8))]
)
def test_fast_sampling_is_the_differential_equation(make):
    """The difference from the flow under a held measurement falls with the first power of the step."""
    observer = make(CHAIN)
    y, u = jnp.array([0.3, -0.2]), jnp.array([0.5, -0.3])
    start = observer.init(jnp.array([0.5, 0.1]))._replace(v=jnp.array([1.0, -2.0]))

    @jax.jit
    def gap(count, dt):
        state = jax.lax.fori_loop(0, count, lambda _, s: observer.step(s, u, y, dt)[0], start)
        exact = rk4(lambda t, s: observer.flow(t, s, u, y), jnp.zeros(()), start, 0.05, 400)
        return jnp.linalg.norm(observer.estimate(state) - observer.estimate(exact))

    counts = np.array([20, 40, 80])
    gaps = [float(gap(jnp.asarray(c), jnp.asarray(0.05 / c))) for c in counts]
    assert -np.polyfit(np.log(counts), np.log(gaps), 1)[0] == pytest.approx(1.0, abs=0.15)


def test_ekf_is_the_textbook_filter_on_a_linear_system():
    stiffness, process, noise, dt = 4.0, 0.5, 1e-4, 0.01
    model = models.oscillator(stiffness=stiffness)
    t = jnp.arange(60.0) * dt
    y = jnp.sin(2 * t)[:, None] + 0.01 * jnp.asarray(RANDOM.normal(size=(60, 1)))
    observer = EKF(model, process * jnp.eye(1), noise * jnp.eye(1), substeps=20)
    found = np.asarray(run(observer, Record(t, jnp.zeros((60, 1)), y)).estimate)

    transition = linalg.expm(np.array([[0.0, 1.0], [-stiffness, 0.0]]) * dt)
    added = process * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    x, cov, output = np.array([float(y[0, 0]), 0.0]), np.diag([noise, 1.0]), np.array([[1.0, 0.0]])
    for k in range(60):
        if k:
            x, cov = transition @ x, transition @ cov @ transition.T + added
        gain = cov @ output.T / (output @ cov @ output.T + noise)
        x, cov = x + (gain * (float(y[k, 0]) - x[0]))[:, 0], (np.eye(2) - gain @ output) @ cov
        assert np.allclose(found[k], x, atol=1e-8)


def test_filters_agree_with_scipy_on_regular_stamps():
    dt, w = 0.01, 25.0
    t = np.arange(80) * dt
    y = np.sin(3 * t)[:, None]
    record = Record(jnp.asarray(t), jnp.zeros((80, 0)), jnp.asarray(y))
    derivative = np.asarray(run(FilteredDerivative(w), record).estimate)[:, 1]
    k = 1 - np.exp(-w * dt)
    expected = signal.lfilter([k], [1, k - 1], np.diff(y[:, 0], prepend=y[0, 0]) / dt)
    assert np.allclose(derivative, expected, atol=1e-12)
    slope = np.asarray(run(SavitzkyGolay(11, 2), record).estimate)[:, 1]
    weights = signal.savgol_coeffs(11, 2, deriv=1, delta=dt, pos=10, use="dot")
    windows = np.lib.stride_tricks.sliding_window_view(y[:, 0], 11)
    assert np.allclose(slope[10:], windows @ weights, atol=1e-6)


def test_filters_are_exact_on_what_they_model_at_irregular_stamps():
    t = np.asarray(STAMPS)
    y = np.stack([2 * t + 1, -t], axis=1)
    y[5:200:7] = np.nan
    ramp = Record(STAMPS, jnp.zeros((len(t), 0)), jnp.asarray(y))
    assert np.allclose(run(FilteredDerivative(80.0), ramp).estimate[-1], [y[-1, 0], y[-1, 1], 2.0, -1.0], atol=1e-6)
    curve = ramp._replace(y=jnp.asarray(y**2))
    expected = [y[-1, 0] ** 2, y[-1, 1] ** 2, 4 * y[-1, 0], 2 * t[-1]]
    assert np.allclose(run(SavitzkyGolay(15, 2), curve).estimate[-1], expected, atol=1e-5)


def test_stiff_friction_is_subdivided():
    """Coulomb friction as atan(100 v) on a light link: one Runge–Kutta step of 4 ms does not do."""
    model = models.pendulum_chain((0.3,), (0.2,), coulomb=(0.08,))
    t = jnp.arange(100.0) * 4e-3
    truth = jax.jit(lambda: simulation.simulate(model, jnp.array([0.8, 0.0]), t))()

    def error(substeps):
        found = run(Intrinsic(model, 20.0, 100.0, substeps=substeps), truth).estimate
        return float(jnp.abs(found - truth.x).max())

    assert error(None) < 1e-3
    assert error(1) > 10 * error(None)


def test_run_is_the_loop_and_compiles_once():
    model, traces = models.oscillator(), []

    def potential(q):
        traces.append(1)
        return 2 * q[0] ** 2

    observer = Intrinsic(models.Lagrangian(model.metric, potential), 3.0, 4.0, substeps=1)
    t = jnp.arange(6.0) * 0.1
    record = Record(t, jnp.zeros((6, 1)), jnp.sin(t)[:, None])
    found = run(observer, record).estimate
    count = len(traces)
    run(observer, record._replace(y=record.y + 1.0))
    assert len(traces) == count
    state = observer.init(record.y[0], record.t[0])
    for k in range(1, 6):
        state, _ = observer.step(state, record.u[k - 1], record.y[k], record.t[k] - record.t[k - 1])
        assert jnp.allclose(observer.estimate(state), found[k], atol=1e-12)


def test_absurd_gains_end_in_a_result_code_not_an_exception():
    record = Record(jnp.arange(50.0) * 0.1, jnp.zeros((50, 2)), jnp.ones((50, 2)))
    wild = escaping()
    result = run(Intrinsic(wild, 1.0, 1.0, substeps=1), record).info.result
    assert result[-1] == Result.NOT_FINITE


def escaping():
    return models.Lagrangian(CHAIN.metric, lambda q: -jnp.sum(jnp.exp(q**2)), inputs=2)


def test_single_precision_stays_single():
    model = models.pendulum_chain((1.0,), (0.5,))
    observer = Intrinsic(model, 5.0, 6.0)
    state = observer.init(jnp.ones(1, jnp.float32))
    new, info = observer.step(state, jnp.zeros(1, jnp.float32), jnp.ones(1, jnp.float32), jnp.float32(0.01))
    assert {a.dtype for a in (new.q, new.v, info.innovation, info.distance)} == {jnp.dtype("float32")}


# The rule for the gains.


def test_gains_are_those_of_the_stationary_kalman_filter():
    std, rate, acceleration, time = 1e-3, 500.0, 2.0, 0.01
    found = design.gains(std, rate, acceleration, time)
    double, input_, output = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    sensed, disturbed = std**2 / rate, 2 * acceleration**2 * time
    cov = linalg.solve_continuous_are(double.T, output.T, disturbed * input_ @ input_.T, np.array([[sensed]]))
    assert np.allclose((cov @ output.T / sensed)[:, 0], [found.alpha, found.beta], rtol=1e-8)
    assert np.allclose(np.sqrt(np.diag(cov)), [found.position_std, found.velocity_std], rtol=1e-8)


@pytest.mark.parametrize(("alpha", "beta"), [(3.0, 5.0), (10.0, 2.0)])
def test_predicted_errors_solve_the_lyapunov_equation(alpha, beta):
    error = np.array([[-alpha, 1.0], [-beta, 0.0]])
    noise = 0.3 * np.outer([alpha, beta], [alpha, beta]) + 0.7 * np.diag([0.0, 1.0])
    cov = linalg.solve_continuous_lyapunov(error, -noise)
    found = design.predict_errors(alpha, beta, 0.3, 0.7)
    assert np.allclose(np.sqrt(np.diag(cov)), [found.position_std, found.velocity_std])


def test_constant_acceleration_leaves_the_bias_it_should():
    error = np.array([[-3.0, 1.0], [-5.0, 0.0]])
    assert np.allclose(np.linalg.solve(error, [0.0, -2.0]), design.bias(3.0, 5.0, 2.0))


@pytest.mark.parametrize("name", ["measurement_std", "rate", "acceleration_std", "correlation_time", "damping"])
def test_gains_name_the_number_that_makes_no_sense(name):
    numbers = {"measurement_std": 1.0, "rate": 1.0, "acceleration_std": 1.0, "correlation_time": 1.0, "damping": 1.0}
    with pytest.raises(ValueError, match=name):
        design.gains(**(numbers | {name: -1.0}))
