"""What takes long of `test_file_sensors.py`."""

import numpy as np
import pandas
import pytest
from test_file_sensors import CHAIN, ROBOT, written

import covariant
from covariant import logs, models
from covariant.observers import Sensor
from covariant.verbs.base.sensors import file_sensors

SENSORS = """
[sensors.rate]
kind = "tachometer"
of = ["q1", "q2"]
columns = ["rate 1", "rate 2"]
units = "deg/s"
std = 0.01
bias = 0.2
[sensors.motor]
kind = "encoder"
of = ["q2"]
columns = ["motor"]
reduction = 20.0
std = 1e-3
"""


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sensors")
    path = written(folder, CHAIN + SENSORS)
    log = covariant.simulate(path, duration=3.0, rate=100.0, q0=[0.6, -0.4], noise=2e-3, seed=1)
    return path, written(folder, CHAIN, "plain.toml"), pandas.DataFrame(log.columns)


@pytest.mark.exhaustive
def test_a_simulated_log_has_their_columns_in_their_units(chain):
    path, _, frame = chain
    rate, motor = file_sensors(models.load(path))
    assert (rate.sensor.name, motor.sensor.name, rate.unit, motor.unit) == ("rate", "motor", "rad/s", "rad")
    off = np.deg2rad(frame["rate 1"]) - frame["true_v1"]
    assert 0.0 < abs(off.mean()) < 1.0  # the bias
    assert 0.008 < off.std() < 0.012
    units = covariant.simulate(path, duration=0.1, rate=100.0).units
    assert (units["rate 1"], units["motor"], units["q1"]) == ("deg/s", "rad", "rad")
    assert np.abs(frame["motor"] - 20.0 * frame["true_q2"]).max() < 6e-3


@pytest.mark.exhaustive
def test_a_filter_uses_them_and_finds_their_bias(chain):
    path, plain, frame = chain
    named = {"observer": "intrinsic-kalman", "columns": {"truth": ["true_v1", "true_v2"]}}
    result = covariant.estimate(path, frame, engine="c", **named)
    without = covariant.estimate(plain, frame, **named)
    assert (result.outcome.score.rmse < 0.5 * without.outcome.score.rmse).all()
    bias = (np.deg2rad(frame[["rate 1", "rate 2"]]) - frame[["true_v1", "true_v2"]].to_numpy()).mean()
    columns = result.columns
    for i in (1, 2):
        off = columns[f"rate_bias{i}"][-1] - bias.iloc[i - 1]
        assert abs(off) < 4 * columns[f"rate_bias{i}_std"][-1] < 0.05
    assert {name: each.readings for name, each in result.sensors.items()} == {"rate": 300, "motor": 300}
    assert all(0.15 < each.nis < 1.3 and each.refused == 0 for each in result.sensors.values())
    assert "rate: 300 readings" in str(result)
    jax = covariant.estimate(path, frame, engine="jax", **named)
    np.testing.assert_allclose(jax.velocity, result.velocity, rtol=0, atol=1e-9)


@pytest.mark.exhaustive
def test_rows_have_what_was_read_then(chain):
    """Positions in every tenth row: the rate of the design is theirs, and the sensor fills the time between."""
    path, plain, frame = chain
    sparse = frame.copy()
    sparse.loc[np.arange(len(frame)) % 10 > 0, ["q1", "q2"]] = np.nan
    named = {"observer": "intrinsic-kalman", "columns": {"truth": ["true_v1", "true_v2"]}}
    result = covariant.estimate(path, sparse, **named)
    assert round(result.loaded.rate) == 10
    assert "coasted" not in result.outcome.counts
    only = covariant.estimate(plain, sparse, **named)
    assert only.outcome.counts["coasted"] == 270
    assert (result.outcome.score.rmse < 0.6 * only.outcome.score.rmse).all()


@pytest.mark.exhaustive
def test_outliers_of_a_sensor_are_counted(chain):
    path, _, frame = chain
    odd = frame.copy()
    odd.loc[[50, 120], "rate 1"] = 1e5
    result = covariant.estimate(path, odd, observer="intrinsic-kalman")
    assert result.sensors["rate"].refused == 2
    assert result.sensors["motor"].refused == 0


@pytest.mark.exhaustive
def test_a_log_without_a_sensor_is_told(chain):
    path, plain, frame = chain
    lacking = frame.drop(columns=["rate 1", "rate 2"])
    result = covariant.estimate(path, lacking, observer="intrinsic-kalman")
    assert "The log has no column of rate: the filter does without." in result.design[0]
    assert result.sensors["rate"].readings == 0
    none = covariant.estimate(path, lacking.drop(columns="motor"), observer="intrinsic-kalman")
    same = covariant.estimate(plain, frame, observer="intrinsic-kalman")
    np.testing.assert_array_equal(none.velocity, same.velocity)
    with pytest.raises(logs.LogError, match="no column 'rate 2'"):
        covariant.estimate(path, frame.drop(columns="rate 2"), observer="intrinsic-kalman")


@pytest.mark.exhaustive
def test_other_observers_say_that_they_do_without(chain):
    path, _, frame = chain
    result = covariant.estimate(path, frame, observer="intrinsic")
    assert "does not estimate what [sensors] read; intrinsic-kalman does" in result.design[0]


@pytest.mark.exhaustive
def test_what_was_measured_is_smoothed_with_them(chain):
    path, _, frame = chain
    named = {"observer": "intrinsic-kalman", "columns": {"truth": ["true_v1", "true_v2"]}}
    summary = covariant.smooth(path, frame, **named).summary
    assert (np.array(summary["velocity_rmse"]) < 0.9 * np.array(summary["filter"]["velocity_rmse"])).all()
    same = covariant.estimate(path, frame, **named).outcome.score.rmse
    np.testing.assert_allclose(summary["filter"]["velocity_rmse"], same, rtol=1e-4)


@pytest.mark.exhaustive
def test_a_smoother_refuses_a_sensor_that_is_late(chain):
    path, _, frame = chain
    late = {"sensors.motor.delay": 0.02}
    with pytest.raises(
        ValueError, match=r"late \(sensors.motor.delay = 0.02\).* `overrides=\['sensors.motor.delay=0'\]`$"
    ):
        covariant.smooth(path, frame, overrides=late)
    covariant.smooth(path, frame, overrides=late, observer="joint-kalman")  # which uses no sensor


@pytest.mark.exhaustive
def test_a_sensor_makes_the_estimate_of_a_force_better(tmp_path):
    text = CHAIN.replace("[1.0, 0.6]", "[1.0]").replace("[0.5, 0.4]", "[0.5]").replace("[0.05, 0.02]", "[0.05]")
    text = text.replace('["q1", "q2"]', '["q1"]') + "external_force_std = 0.2\nexternal_force_time = 0.3\n"
    rate = '[sensors.rate]\nkind = "tachometer"\nof = ["q1"]\ncolumns = ["w"]\nstd = 0.01\nbias = 0.1\n'
    path = written(tmp_path, text + rate)
    log = covariant.simulate(path, duration=6.0, rate=50.0, q0=[0.5], noise=2e-3, push=[0.5])
    frame, true = pandas.DataFrame(log.columns), log.columns[log.force_columns[0]]
    with_rate, without = (
        covariant.estimate(each, frame, observer="intrinsic-kalman")
        for each in (path, written(tmp_path, text, "plain.toml"))
    )
    errors = [np.std(each.columns["external_force1"][50:] - true[50:]) for each in (with_rate, without)]
    assert errors[0] < 0.9 * errors[1]
    # At the end of a log nothing but its last moments tells of a force that is forgotten: the bias alone is named.
    assert [each.name for each in with_rate.determined] == ["rate_bias"]


@pytest.mark.exhaustive
def test_a_gyro_and_a_late_camera_on_a_robot(tmp_path):
    path = written(tmp_path, ROBOT)
    log = covariant.simulate(path, duration=2.0, rate=100.0, q0=[0.6, -0.4], amplitude=[0.3, 0.3], noise=1e-3)
    named = {"observer": "intrinsic-kalman", "columns": {"truth": list(log.truth_columns)}}
    result = covariant.estimate(path, pandas.DataFrame(log.columns), engine="c", **named)
    without = covariant.estimate(
        written(tmp_path, ROBOT[: ROBOT.index("[sensors.imu]")], "plain.toml"), pandas.DataFrame(log.columns), **named
    )
    assert (result.outcome.score.rmse < without.outcome.score.rmse).all()
    assert result.sensors["camera"].readings == 200
    assert all(0.6 < each.nis < 1.4 for each in result.sensors.values())


def test_the_classes_are_those_of_the_library(chain):
    assert all(isinstance(part.sensor, Sensor) for part in file_sensors(models.load(chain[0])))
