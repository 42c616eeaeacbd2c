"""Properties that a simulated sensor must have whatever its numbers."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from covariant.simulation import PositionSensor, sense, stamps

RATES = st.floats(1.0, 1e4)
SEEDS = st.integers(0, 2**31)


@given(rate=RATES, samples=st.integers(2, 400), jitter=st.floats(0, 10), seed=SEEDS)
def test_stamps_increase_from_zero_to_the_end(rate, samples, jitter, seed):
    t = stamps(PositionSensor(rate, jitter=jitter / rate), (samples - 0.5) / rate, seed)
    assert len(t) == samples
    assert t[0] == 0.0
    assert (np.diff(t) >= 0.09 / rate).all()
    assert np.abs(t - np.arange(samples) / rate).max() <= 0.4500001 / rate


@pytest.mark.parametrize(
    ("duration", "rate"), [(0.29, 100.0), (0.57, 100.0), (1.1, 10.0), (2.3, 1000.0), (4.35, 100.0)]
)
def test_the_last_stamp_is_the_end(duration, rate):
    t = stamps(PositionSensor(rate), duration)
    assert t[-1] == pytest.approx(duration, abs=1e-12)


@given(quantum=st.floats(1e-6, 10.0), seed=SEEDS)
def test_readings_are_whole_steps_and_the_nearest_ones(quantum, seed):
    q = np.random.default_rng(seed).normal(0, 5, (50, 2))
    y = sense(PositionSensor(100.0, quantum=quantum), q, seed)
    np.testing.assert_array_equal(y, np.round(y / quantum) * quantum)
    assert np.abs(y - q).max() <= quantum / 2 * (1 + 1e-9)


def test_positions_of_different_units_have_a_step_and_a_noise_each():
    q = np.random.default_rng(3).normal(0, 5, (4000, 3))
    y = sense(PositionSensor(100.0, quantum=[0.5, 0.0, 2e-3]), q)
    assert np.abs(y[:, 0] / 0.5 - np.round(y[:, 0] / 0.5)).max() == 0
    np.testing.assert_array_equal(y[:, 1], q[:, 1])
    assert 0.9e-3 < np.abs(y[:, 2] - q[:, 2]).max() <= 1e-3 * (1 + 1e-9)
    error = sense(PositionSensor(100.0, noise_std=(0.1, 0.0, 3.0)), q) - q
    assert np.std(error, axis=0) == pytest.approx([0.1, 0.0, 3.0], rel=0.05)
    for name in ("noise_std", "quantum"):
        with pytest.raises(ValueError, match=f"sensor: {name} has 2 numbers for 3 positions"):
            sense(PositionSensor(100.0)._replace(**{name: [0.1, 0.2]}), q)
        with pytest.raises(ValueError, match=f"sensor: {name} must be a number ≥ 0"):
            sense(PositionSensor(100.0)._replace(**{name: [0.1, -0.2, 0.1]}), q)


def test_without_faults_a_sensor_reads_the_truth():
    q = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_array_equal(sense(PositionSensor(100.0), q), q)


def test_noise_has_the_spread_asked_for_and_is_independent():
    error = sense(PositionSensor(100.0, noise_std=0.2), np.zeros((20_000, 2)), 4)
    np.testing.assert_allclose(np.cov(error.T), 0.04 * np.eye(2), atol=0.04 * 5 / math.sqrt(20_000))
    assert np.abs(np.mean(error[1:] * error[:-1], axis=0)).max() < 0.04 * 5 / math.sqrt(20_000)


def test_jitter_has_the_spread_asked_for():
    t = stamps(PositionSensor(100.0, jitter=5e-4), 100.0, 1)
    assert np.std(t - np.arange(len(t)) / 100) == pytest.approx(5e-4, rel=0.05)


@given(dropout=st.floats(0, 0.99), seed=SEEDS)
def test_the_first_row_is_there_and_rows_are_lost_whole(dropout, seed):
    y = sense(PositionSensor(100.0, dropout=dropout), np.ones((40, 3)), seed)
    assert np.isfinite(y[0]).all()
    assert (np.isnan(y).all(1) == np.isnan(y).any(1)).all()


@pytest.mark.parametrize("dropout", [0.0, 0.1, 0.6])
def test_rows_are_lost_as_often_as_asked(dropout):
    lost = np.isnan(sense(PositionSensor(100.0, dropout=dropout), np.zeros((20_000, 1)), 2)[:, 0])
    assert lost.mean() == pytest.approx(dropout, abs=5 * math.sqrt(dropout * (1 - dropout) / 20_000))


def test_a_seed_repeats_everything_and_another_changes_it():
    sensor = PositionSensor(200.0, 0.1, 0.01, 1e-4, 0.2)
    q = np.zeros((101, 2))

    def everything(seed):
        return stamps(sensor, 0.5, seed), sense(sensor, q, seed)

    for one, two in zip(everything(7), everything(7), strict=True):
        np.testing.assert_array_equal(one, two)
    for one, two in zip(everything(7), everything(8), strict=True):
        assert not np.array_equal(one, two, equal_nan=True)


@pytest.mark.parametrize("number", [-1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["rate", "noise_std", "quantum", "jitter", "dropout"])
def test_a_number_that_makes_no_sense_is_named(name, number):
    sensor = PositionSensor(100.0)._replace(**{name: number})
    for use in (lambda: sensor.check(), lambda: stamps(sensor, 1.0), lambda: sense(sensor, np.zeros((3, 1)))):
        with pytest.raises(ValueError, match=f"sensor: {name} .*{number}"):
            use()


@pytest.mark.parametrize("sensor", [PositionSensor(0.0), PositionSensor(100.0, dropout=1.0)])
def test_a_sensor_that_never_reads_is_refused(sensor):
    with pytest.raises(ValueError, match="sensor: "):
        sensor.check()


@pytest.mark.parametrize("duration", [0.0, 0.005, -1.0, math.nan, math.inf])
def test_a_duration_that_holds_no_two_samples_is_refused(duration):
    with pytest.raises(ValueError, match=f"{duration} s"):
        stamps(PositionSensor(100.0), duration)
