"""Sensors of a model file: their columns in a log, their use by a filter, and what is wrong with a table."""

import numpy as np
import pandas
import pytest

import covariant
from covariant import logs, models
from covariant.models.files._sensor_keys import SENSOR_KEYS
from covariant.observers.sensors import SENSOR_KINDS
from covariant.verbs.base.sensors import file_sensors

CHAIN = """
system = "pendulum_chain"
[parameters]
mass = [1.0, 0.6]
length = [0.5, 0.4]
viscous = [0.05, 0.02]
[columns]
q = ["q1", "q2"]
[measurement]
std = 2e-3
[uncertainty]
acceleration = 1.0
correlation_time = 0.02
"""
ROBOT = """
system = "robot"
[parameters]
path = "double_pendulum"
[measurement]
std = 1e-3
[uncertainty]
acceleration = 1.0
correlation_time = 0.02
[sensors.imu]
kind = "gyro"
link = "lower"
columns = ["wx", "wy", "wz"]
std = 0.01
[sensors.camera]
kind = "pose"
link = "lower"
columns = ["cx", "cy", "cz", "cw", "ci", "cj", "ck"]
attitude = "quaternion_wxyz"
position_std = 2e-3
rotation_std = 5e-3
delay = 0.02
"""


def written(tmp_path, text, name="model.toml"):
    path = tmp_path / name
    path.write_text(text)
    return str(path)


RATE = '[sensors.a]\nkind = "tachometer"\nof = ["q1"]\ncolumns = ["x"]\nstd = 1'


@pytest.mark.core(6)
@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('[sensors.a]\nkind = "sonar"', r"\[sensors.a\] needs a kind, one of encoder, tachometer.*'sonar'"),
        ('[sensors.a]\nkind = "tachometer"\nof = ["q1"]', r"\[sensors.a\] needs columns, std"),
        (f'{RATE}\nlink = "b"', "key of .*'link'"),
        (RATE.replace("q1", "q3"), "there is no 'q3'; there are: "),
        (RATE.replace('["x"]', '["x", "y"]'), "1 different names"),
        (RATE.replace("= 1", "= -1"), "std must be .* numbers ≥ 0"),
        (f"{RATE}\ndelay = -1", r"sensors.a.delay must be .* ≥ 0"),
        (RATE.replace("x", "q2"), "'q2' is named twice"),
        (f'{RATE}\nunits = "mm"', "no unit of"),
        ('[sensors.a]\nkind = "gyro"\nlink = "b"\ncolumns = ["x", "y", "z"]\nstd = 1', "has no links"),
        ("[sensors]\na = 1", r"sensors.a must be a table"),
    ],
)
def test_a_table_that_makes_no_sense_is_named(table, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        file_sensors(models.load(written(tmp_path, f"{CHAIN}\n{table}\n")))


def test_a_unit_in_the_name_of_a_column_is_not_overlooked(tmp_path):
    table = '[sensors.a]\nkind = "tachometer"\nof = ["q1"]\ncolumns = ["rate [deg/s]"]\nstd = 0.01\n'
    path = written(tmp_path, CHAIN + table)
    frame = pandas.DataFrame({"t": np.arange(5) / 10, "q1": 0.1, "q2": 0.2, "u1": 0.0, "u2": 0.0, "rate [deg/s]": 1.0})
    with pytest.raises(logs.LogError, match=r'column .rate \[deg/s\]. has a unit in its name.* units = "deg/s"'):
        covariant.estimate(path, frame, observer="intrinsic-kalman")


def test_every_kind_of_a_model_file_has_a_class():
    assert list(SENSOR_KINDS) == list(SENSOR_KEYS)


def test_exported_code_names_every_number_of_a_reading(tmp_path):
    """An attitude is a matrix in the code, whatever the log has."""
    imu, camera = file_sensors(models.load(written(tmp_path, ROBOT)))
    assert imu.signals == ("wx [rad/s]", "wy [rad/s]", "wz [rad/s]")
    assert len(camera.signals) == camera.sensor.count
    assert camera.signals[2:5] == ("cz [m]", "camera R11", "camera R12")
