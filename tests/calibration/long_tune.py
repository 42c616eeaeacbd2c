"""What takes long of `test_tune.py`."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_tune import ACCELERATION, MODEL, RATE, STD, STIFFNESS, log, swing

from covariant.calibration import DataSheet, Trial, filter_error, gains, tune
from covariant.calibration.identification import NoiseLevels, Unknowns, stretch
from covariant.calibration.identification._error_model import error_model, kalman
from covariant.models import Motion
from covariant.observers import Intrinsic, IntrinsicForce, IntrinsicKalman, SavitzkyGolay, external_force, run
from covariant.signals import Record
from covariant.simulation import hold, simulate


@pytest.fixture(scope="module")
def tuned(log):
    record, v = log
    y = record.y.copy()
    y[[900, 1400, 3300]] += 1.0
    y[1500:1520] = np.nan
    return tune(MODEL, [record._replace(y=y)], [v])


@pytest.fixture(scope="module")
def without_model(log):
    """Least velocity error of a filter without a model on the last third, as a part of the velocity."""
    record, v = log
    late = record.t > record.t[-1] * 2 / 3
    trial, sheet = Trial(record.t[late], record.y[late], v[late]), DataSheet(STD, ACCELERATION)
    filters = (SavitzkyGolay(window, order) for order in (2, 3) for window in range(5, 80))
    return min(filter_error(each.weights(RATE), sheet, RATE, trial) for each in filters)


@pytest.mark.exhaustive
def test_noise_and_gains_are_those_of_the_simulation_in_spite_of_outliers_and_gaps(tuned):
    assert float(tuned.noise.acceleration) == pytest.approx(ACCELERATION, rel=0.1)
    np.testing.assert_allclose(tuned.noise.measurement, STD, rtol=0.1)
    assert tuned.noise.force == 0
    best = gains(STD, RATE, ACCELERATION / np.sqrt(2), 1.0)
    assert tuned.natural_frequency == pytest.approx(best.beta**0.5, rel=0.25)
    assert tuned.damping == pytest.approx(0.5**0.5, rel=0.25)


@pytest.mark.exhaustive
def test_what_is_held_out_confirms_it(tuned, without_model):
    assert tuned.after.nis == pytest.approx(1.0, abs=0.15)
    assert np.abs(tuned.after.correlation).max() < 0.1
    assert tuned.after.kalman_error[0] < 1.03 * tuned.after.gains_error[0]
    assert max(tuned.after.relative) < without_model


@pytest.mark.exhaustive
def test_with_a_metric_that_is_too_large_the_filter_is_as_good_as_one_without_a_model(log, without_model):
    """A missing force is found, and makes up for it; the innovations of constant gains tell of it."""
    record, v = log
    found = tune(swing(1.5), [record], [v])
    assert np.any(found.noise.force > 0)
    assert found.after.relative[1] < 1.02 * without_model


@pytest.mark.exhaustive
def test_where_the_model_explains_nothing_the_force_grows_until_the_estimate_is_one_without_a_model(log, without_model):
    """The inertia is five times too large, so that the spring explains little of the motion."""
    record, v = log
    found = tune(swing(5.0), [record], [v])
    assert found.noise.force[0] > 5.0  # [N], of the spring's 20
    assert found.force_rate > 0
    assert found.after.relative.max() < 1.05 * without_model


@pytest.mark.exhaustive
@pytest.mark.parametrize("time", [np.inf, 0.4])
def test_the_filter_of_the_errors_is_the_kalman_filter(log, time):
    """On a linear system exactly, whatever observer the errors are those of; with a force that is not known too."""
    record = Record(*(np.asarray(a[:300]) for a in log[0][:3]))
    noise = NoiseLevels(jnp.asarray(0.4), jnp.array([2e-3]), jnp.asarray(0.7), jnp.asarray(time))
    t, u, y = map(jnp.asarray, record[:3])
    along = run(Intrinsic(MODEL, 3.0, 5.0), record).estimate
    rows = stretch(t, y, u, Motion(along[:, :1], along[:, 1:]))
    found = kalman(error_model(Unknowns.none(MODEL), jnp.zeros(0), rows.start, rows, 4), noise, 2.0)
    axes = jnp.eye(1)
    force = external_force(0.49 * axes) if np.isinf(time) else external_force(std=0.7, time=time)
    filtered = IntrinsicKalman(MODEL, 0.16 * axes, 4e-6 * axes, 4.0 * axes, force, gate=None, substeps=4)
    done = run(filtered, record)
    later = slice(20, None)  # the first innovations are taken for outliers here
    np.testing.assert_allclose((along + found.error)[later, 1], done.estimate[later, 1], atol=2e-3)
    np.testing.assert_allclose(found.spread[later, 0] ** 2, done.info.innovation_cov[later, 0, 0], rtol=1e-2)


PUSH, TIME = 2.0, 0.5


@pytest.fixture(scope="module")
def pushed():
    """A log of the swing under a Gauss–Markov force, of small steps of the exact process, and its velocities."""
    rng, t = np.random.default_rng(3), np.arange(0, 24.0, 0.02)
    h, force, q, v, path = 0.001, 0.0, 0.5, 0.0, []
    decay = np.exp(-h / TIME)
    for i in range(len(t) * 20):
        if i % 20 == 0:
            path.append((q, v))
        force = decay * force + PUSH * np.sqrt(1 - decay**2) * rng.normal()
        v += h * (force - STIFFNESS * q)
        q += h * v
    q, v = np.array(path).T
    return Record(t, np.zeros((len(t), 1)), (q + STD * rng.normal(size=len(t)))[:, None]), v[:, None]


@pytest.mark.exhaustive
def test_size_and_time_of_a_force_that_is_forgotten_are_those_of_the_simulation(pushed):
    record, v = pushed
    sheet = DataSheet(STD, 1.0, external_force_std=0.05, external_force_time=5.0)
    found = tune(MODEL, [record], [v], before=sheet)
    assert float(found.noise.force[0]) == pytest.approx(PUSH, rel=0.3)
    assert float(found.noise.force_time) == pytest.approx(TIME, rel=0.6)
    assert found.before is not None
    assert found.after.kalman_error[0] < 0.9 * found.before.kalman_error[0]
    assert found.after.likelihood > found.before.likelihood


@pytest.mark.exhaustive
def test_gains_of_the_model_file_that_are_as_good_as_any_are_kept_and_worse_ones_are_not(log):
    record, v = log
    best = gains(STD, RATE, ACCELERATION / np.sqrt(2), 1.0)
    good, bad = (
        tune(MODEL, [record], [v], before=DataSheet(STD, ACCELERATION / np.sqrt(2), 1.0, natural_frequency=frequency))
        for frequency in (best.beta**0.5, 6 * best.beta**0.5)
    )
    for each in (good, bad):
        errors = {one.source: one.smoothed for one in each.candidates}
        assert errors[each.source] <= errors["model file"]
        assert each.before is not None
        assert each.after.gains_error[0] <= 1.02 * each.before.gains_error[0]
    assert bad.before is not None
    assert bad.source != "model file"
    assert bad.after.gains_error[0] < 0.7 * bad.before.gains_error[0]


@pytest.mark.exhaustive
def test_under_a_force_that_lasts_gains_are_nearly_those_with_the_least_velocity_error():
    """Predictions would favour gains that are too fast: the push is in all of them, to the side of the lag."""
    t, rng = np.arange(0, 60.0, 0.05), np.random.default_rng(5)
    force = 1.0 + 0.5 * np.sin(0.2 * t)
    true = simulate(MODEL, jnp.array([0.5, 0.0]), jnp.asarray(t), hold(jnp.asarray(t), jnp.asarray(force[:, None])))
    v = np.asarray(true.x)[:, 1:]
    record = Record(t, np.zeros((len(t), 1)), np.asarray(true.y) + 0.01 * rng.normal(size=(len(t), 1)))
    found = tune(MODEL, [record], [v])
    assert np.all(found.noise.force > 0)

    def error(frequency, damping, rate):
        observer = IntrinsicForce(MODEL, 2 * damping * frequency, frequency**2, rate)
        estimate = run(observer, record, ("result",)).estimate
        return np.sqrt(np.mean((np.asarray(estimate)[:, 1] - v[:, 0])[t > 40.0] ** 2))

    frequencies, dampings, ratios = np.geomspace(0.5, 10.0, 12), (0.3, 0.5, 0.7, 1.0), (0.0, 0.1, 0.3, 0.6)
    best = min(error(w, z, r * w) for w in frequencies for z in dampings for r in ratios)
    assert error(found.natural_frequency, found.damping, found.force_rate) < 1.05 * best
