"""`covariant.simulate` from Python: its record, its tables, and the units of the model file."""

import re

import numpy as np
import pytest

from covariant import logs, models
from covariant.verbs import simulate
from covariant.verbs._simulate import SimulateResult

ARM = {
    "columns.q": ["shoulder", "elbow"],
    "units.q": ["deg", "mrad"],
    "parameters.mass": [1.0, 0.5],
    "parameters.length": [0.5, 0.4],
}


@pytest.fixture(scope="module")
def arm() -> SimulateResult:
    return simulate(
        "pendulum_chain",
        duration=1.0,
        rate=100.0,
        q0=[0.5, -0.2],
        amplitude=[1.0, 0.5],
        quantum=[0.1, 1e-3],
        noise=(0.0, 1e-2),
        dropout=0.1,
        overrides=ARM,
    )


def test_the_record_is_what_was_read_and_its_truth(arm):
    record = arm.record
    assert record.y.shape == (101, 2)
    assert record.x.shape == (101, 4)
    seen = np.isfinite(record.y[:, 0])
    assert 0 < (~seen).sum() < 30
    steps = record.y[seen] / [0.1, 1e-3]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.abs(record.y[seen, 0] - record.x[seen, 0]).max() <= 0.05 * (1 + 1e-9)
    assert 2e-3 < np.std(record.y[seen, 1] - record.x[seen, 1]) < 2e-2


def test_the_table_is_in_the_units_of_the_model_file(arm, tmp_path):
    table = arm.to_pandas()
    positions, truth = ["shoulder", "elbow"], ["true_v1", "true_v2"]
    assert list(table) == ["t", *positions, "u1", "u2", *(f"true_{name}" for name in positions), *truth]
    np.testing.assert_allclose(table["true_shoulder"], np.degrees(arm.record.x[:, 0]))
    np.testing.assert_allclose(table["elbow"], 1e3 * arm.record.y[:, 1])
    assert (arm.units["shoulder"], arm.units["elbow"], arm.units["true_v1"]) == ("deg", "mrad", "rad/s")
    path = arm.save(tmp_path / "log.csv")
    file = models.load("pendulum_chain", ARM)
    read = logs.read(path, file.columns._replace(truth=arm.truth_columns))
    np.testing.assert_allclose(read.record.y, arm.record.y, rtol=1e-14)
    np.testing.assert_allclose(np.asarray(read.truth), arm.record.x[:, 2:], rtol=1e-14)


def test_what_is_printed_says_what_there_is(arm):
    assert str(arm) == '101 rows; score against `columns["truth"]` true_v1,true_v2'
    assert repr(arm) == "<SimulateResult: 101 rows over 1 s of pendulum_chain>"
    assert arm.summary == {"model": "pendulum_chain", "rows": 101, "truth_columns": "true_v1,true_v2"}


def test_systems_themselves_and_model_files_are_simulated():
    for model in (models.oscillator(), models.load("oscillator")):
        result = simulate(model, duration=0.5, rate=20.0, q0=1.0)
        np.testing.assert_allclose(result.record.y[:, 0], np.cos(result.record.t), atol=1e-9)


@pytest.mark.exhaustive
def test_joints_that_leave_their_limits_are_named_with_the_time():
    """A lift of .18 m falls."""
    result = simulate("scara", duration=0.3, rate=100.0)
    (warning,) = result.warnings
    # It falls by g t²/2, a little slower for its friction: the limit is reached after √(2·0.18/9.81) = 0.19 s.
    assert re.match(
        r"joint 'lift' leaves its limits -0\.18 to 0 m at t = 0\.[12]\d? s and reaches -0\.\d+ m; nothing", warning
    )
    assert warning in str(result)
    assert result.summary["warnings"] == [warning]


@pytest.mark.exhaustive("heavy_top-asked1-begins with v0 = 1, 1, 1")
@pytest.mark.parametrize(
    ("model", "asked", "said"),
    [
        ("oscillator", {}, "begins with v0 = 1; give q0, v0 or amplitude"),
        ("heavy_top", {}, "begins with v0 = 1, 1, 1"),
        ("duffing", {}, "begins with q0 = "),
        ("oscillator", {"amplitude": [0.0]}, "nothing moves in this log"),
        ("oscillator", {"v0": [0.5]}, ""),
    ],
)
def test_a_log_in_which_nothing_was_asked_to_move_moves_and_says_so(model, asked, said):
    result = simulate(model, duration=0.2, rate=50.0, **asked)
    assert said in " ".join(result.warnings)
    assert bool(result.warnings) == bool(said)
    assert bool(np.ptp(result.record.y, axis=0).any()) == ("nothing moves in" not in said)
