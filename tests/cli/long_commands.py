"""The commands on good input: what they print and write: what takes long."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import command, leave
from test_commands import MODEL, READ, folder, inside, simulate

from covariant import logs
from covariant.models import load
from covariant.observers import EKF, run
from covariant.verbs.base.outcome import KEPT

SWING = ("--duration", "2", "--rate", "200", "--v0", "3.0", "--amplitude", "0.5")


@pytest.fixture(scope="module")
def estimated(folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return command(
            *("estimate", "model.toml", "log.csv", "-o", "v.csv", "--truth", "true_v1", "--report", "report.html")
        )


def test_simulate_writes_measurements_inputs_and_truth():
    log = logs.read("log.csv", logs.Columns(q=("angle",), u=("torque",), truth=("true_v1",)))
    assert len(log.record.t) == 801
    assert np.isnan(log.record.y).any()
    steps = log.record.y[np.isfinite(log.record.y)] / 1e-3
    assert np.allclose(steps, np.round(steps), atol=1e-6)


def test_simulate_repeats_by_seed():
    for out, seed in (("again.csv", 1), ("other.csv", 2)):
        simulate(out, seed)
    assert Path("again.csv").read_bytes() == Path("log.csv").read_bytes()
    assert Path("other.csv").read_bytes() != Path("log.csv").read_bytes()


@pytest.mark.exhaustive
def test_estimate_prints_what_it_found(estimated):
    assert estimated["rows"] == 801
    assert estimated["scored_against"] == "true velocity"
    assert estimated["results"]["coasted"] > 0
    assert set(estimated["results"]) == {"ok", "coasted"}
    assert estimated["velocity_rmse"][0] < 0.05


@pytest.mark.exhaustive
def test_a_filter_that_knows_how_accurate_it_is_writes_that_too():
    """The standard deviation is that of the errors, in the order of magnitude; a log in no ticks is told as noise."""
    command("estimate", "model.toml", "log.csv", "--observer", "intrinsic-kalman", "-o", "std.csv")
    assert Path("std.csv").read_text().splitlines()[0] == "t,q1,v1,v1_std"
    found = logs.read("std.csv", logs.Columns(t="t", q=("q1",), u=("v1_std",), truth=("v1",)))
    truth = logs.read("log.csv", logs.Columns(q=("angle",), u=(), truth=("true_v1",))).truth
    std = np.asarray(found.record.u)[200:, 0]
    off = np.asarray(found.truth - truth)[200:, 0]
    assert (std > 0).all()
    assert 0.3 < np.sqrt(np.mean(off**2)) / std.mean() < 1.5
    quick = ("estimate", "model.toml", "log.csv", "--observer", "filtered-derivative")
    told = command(*quick, "--set", "measurement.quantum=7e-4")["design"]
    assert "Positions are not whole ticks of 0.0007 apart" in told
    assert "whole ticks" not in command(*quick)["design"]


@pytest.mark.exhaustive
def test_estimate_writes_stamps_positions_and_velocities(estimated):
    assert Path(estimated["out"]).read_text().splitlines()[0] == "t,q1,v1"
    log = logs.read("v.csv", READ)
    assert np.isfinite(log.truth).all()
    assert len(log.record.t) == 801


def test_parquet_holds_the_same_numbers(estimated):
    command("estimate", "model.toml", "log.csv", "-o", "v.parquet", "--truth", "true_v1")
    one, two = logs.read("v.csv", READ), logs.read("v.parquet", READ)
    assert np.array_equal(one.record.y, two.record.y)
    assert np.array_equal(one.truth, two.truth)


def test_the_report_is_one_page_and_figures(estimated):
    assert [Path(p).suffix for p in estimated["report"]] == [".html", ".png", ".png", ".png"]
    assert all(Path(p).stat().st_size > 10_000 for p in estimated["report"])


def test_a_wrapped_log_gives_the_same_velocities(estimated):
    log = logs.read("log.csv", logs.Columns(q=("angle",), u=("torque",)))
    assert np.nanmax(np.abs(log.record.y)) > np.pi
    wrapped = np.mod(log.record.y[:, 0] + np.pi, 2 * np.pi) - np.pi
    logs.write("wrapped.csv", {"time": log.record.t, "wrapped": wrapped, "tau": log.record.u[:, 0]})
    command("estimate", "model.toml", "wrapped.csv", "-o", "w.csv", "--t", "time", "--q", "wrapped", "--u", "tau")
    assert np.allclose(logs.read("w.csv", READ).truth, logs.read("v.csv", READ).truth, atol=1e-9)


def test_machines_get_the_documented_keys(estimated):
    assert list(estimated) == [
        *("model", "log", "observer", "rows", "engine", "scored_against", "design"),
        *("velocity_rmse", "velocity_median_error", "innovation_rms", "nis", "nees", "results"),
        *("without_model", "report", "out"),
    ]
    assert estimated["nis"] is estimated["nees"] is None  # the observer has no covariance
    missing = np.isnan(logs.read("log.csv", logs.Columns(q=("angle",))).record.y).sum()
    assert estimated["results"] == {"ok": 801 - missing, "coasted": missing}


def test_logged_velocities_are_compared_with_and_never_used(estimated):
    arguments = ("estimate", "model.toml", "log.csv", "--truth", "true_v1", "-o", "with_v.csv")
    result = command(*arguments, "--v", "true_v1")
    assert result["logged_velocity_rmse"] == [0.0]
    assert result["difference_to_logged_velocity"] == pytest.approx(result["velocity_rmse"], rel=1e-5)
    assert Path("with_v.csv").read_bytes() == Path("v.csv").read_bytes()


def test_people_get_the_same_in_words(estimated):
    code, out, error = leave("estimate", "model.toml", "log.csv", "--truth", "true_v1")
    assert (code, error) == (0, "")
    assert estimated["design"] in out
    assert f"{estimated['velocity_rmse'][0]:.4g} rad/s" in out
    assert f"innovation RMS: {estimated['innovation_rms'][0]:.4g} rad" in out
    assert f"{estimated['results']['coasted']} of 801 samples: no measurement" in out
    assert "engine" not in out


@pytest.mark.exhaustive
@pytest.mark.parametrize("arguments", [("estimate",), ("compare", "--truth", "true_v1")])
def test_people_are_told_why_compiled_c_did_not_do_the_work(arguments, monkeypatch):
    monkeypatch.setattr("covariant.engine._choice.missing", lambda: "there is no C compiler here")
    code, out, _ = leave(arguments[0], "model.toml", "log.csv", *arguments[1:])
    assert code == 0
    [line] = [line for line in out.splitlines() if line.startswith("engine")]
    assert line.endswith(": jax: there is no C compiler here")


@pytest.mark.exhaustive
def test_compare_ranks_all_estimators():
    result = command("compare", "model.toml", "log.csv", "--truth", "true_v1", "-o", "table.csv")
    names = [row["estimator"] for row in result["ranking"]]
    assert len(names) == len(set(names)) == 17
    errors = [row["velocity_rmse"][0] for row in result["ranking"]]
    assert errors == sorted(errors)
    model_free = {"filtered-derivative", "pll", "pll3", "high-gain", "levant", "savitzky-golay", "joint-kalman"}
    assert set(names[-7:]) == model_free
    table = [line.split(",") for line in Path("table.csv").read_text().splitlines()]
    assert table[0] == ["rank", "estimator", "v1_rmse", "nis", "nees", "microseconds"]
    knows = {row["estimator"] for row in result["ranking"] if row["nis"] is not None}
    assert knows == {"intrinsic-kalman", "ekf", "ukf", "joint-kalman"}
    assert {row[1] for row in table[1:] if row[3] and row[4]} == knows
    assert {row[1] for row in table[1:] if row[3] or row[4]} == knows
    assert [row[:2] for row in table[1:]] == [[str(k), name] for k, name in enumerate(names, start=1)]
    assert [float(row[2]) for row in table[1:]] == pytest.approx(errors, rel=1e-5)


@pytest.mark.exhaustive
def test_a_late_sensor_is_simulated_and_estimated_from():
    """At the same stamps, a reading is what it was two samples before; told so, the estimate is hardly worse."""
    late = ("--set", "measurement.delay=0.01")
    command("simulate", "model.toml", "-o", "late.csv", *SWING, *late)
    columns = logs.Columns(q=("angle",), u=("torque",), truth=("true_angle",))
    log = logs.read("late.csv", columns)
    np.testing.assert_allclose(log.record.y[2:, 0], log.truth[:-2, 0], rtol=0, atol=1e-9)
    assert log.record.t[0] == 0.01
    score = ("--truth", "true_v1")
    told = command("estimate", "model.toml", "late.csv", *score, *late)
    untold = command("estimate", "model.toml", "late.csv", *score)
    assert "Positions are read 10 ms late." in told["design"]
    assert told["velocity_rmse"][0] < 0.1 * untold["velocity_rmse"][0]


def test_without_being_asked_nothing_is_scored():
    found = command("estimate", "model.toml", "log.csv", "-o", "plain.csv", "--v", "true_v1")
    assert not {"scored_against", "velocity_rmse", "nees", "logged_velocity_rmse"} & set(found)
    assert Path("plain.csv").read_bytes() == Path("v.csv").read_bytes()
    printed = leave("estimate", "model.toml", "log.csv").out
    assert "RMSE" not in printed
    assert "innovation RMS: " in printed


@pytest.mark.exhaustive
def test_a_torque_that_nobody_told_is_found_and_leaves_no_bias():
    """The torque in the log lacks 0.2 N m of what acts: a bias of the velocity, and none where it is estimated."""
    log = logs.read("log.csv", logs.Columns(q=("angle",), u=("torque",), truth=("true_v1",)))
    told = {"t": log.record.t, "angle": log.record.y[:, 0], "torque": log.record.u[:, 0] - 0.2}
    logs.write("untold.csv", told | {"true_v1": log.truth[:, 0]})
    arguments = ("estimate", "model.toml", "untold.csv", "--truth", "true_v1", "--observer", "intrinsic-kalman")
    late = log.record.t > 1.0
    biases = []
    for name, asked in (("without.csv", ()), ("with.csv", ("--set", "uncertainty.external_force=0.2"))):
        command(*arguments, *asked, "-o", name)
        biases.append(abs(np.mean(logs.read(name, READ).truth[late] - log.truth[late])))
    assert biases[1] < 0.1 * biases[0]
    assert Path("without.csv").read_text().splitlines()[0] == "t,q1,v1,v1_std"
    assert Path("with.csv").read_text().splitlines()[0] == "t,q1,v1,v1_std,external_force1,external_force1_std,pushed"
    force = logs.read("with.csv", logs.Columns(q=("external_force1", "external_force1_std"))).record.y
    assert force[late, 0].mean() == pytest.approx(0.2, rel=0.1)
    assert np.all(force[late, 1] > 0)
    assert "intrinsic-kalman does" in command(*arguments[:3], "--set", "uncertainty.external_force=0.2")["design"]


@pytest.mark.exhaustive
def test_an_encoder_that_is_off_and_a_payload_are_found():
    """The angle in the log is off by .05 rad, and the model's mass by half; both are told of in the model file."""
    log = logs.read("log.csv", logs.Columns(q=("angle",), u=("torque",), truth=("true_v1",)))
    told = {"t": log.record.t, "angle": log.record.y[:, 0] + 0.05, "torque": log.record.u[:, 0]}
    logs.write("off.csv", told | {"true_v1": log.truth[:, 0]})
    mass = float(np.asarray(load("model.toml").model.parameters["mass"].value)[0])
    arguments = ("estimate", "model.toml", "off.csv", "--observer", "intrinsic-kalman")
    bias, payload = "measurement.bias=0.1", 'uncertainty.parameters={"mass[0]"=0.5}'
    command(*arguments, "--set", bias, "-o", "bias.csv")
    assert Path("bias.csv").read_text().splitlines()[0] == "t,q1,v1,v1_std,bias1,bias1_std"
    found = logs.read("bias.csv", logs.Columns(q=("bias1", "bias1_std"))).record.y[-1]
    assert abs(found[0] - 0.05) < 3 * found[1] < 0.02
    both = ("--set", f"parameters.mass=[{mass / 2}]", "--set", bias, "--set", payload)
    command(*arguments, *both, "-o", "both.csv", "--anyway")
    assert Path("both.csv").read_text().splitlines()[0].endswith("v1_std,mass[0],bias1,mass[0]_std,bias1_std")
    found = logs.read("both.csv", logs.Columns(q=("mass[0]", "mass[0]_std", "bias1"))).record.y
    assert abs(found[-1, 0] - mass) < 3 * found[-1, 1] < 0.2 * mass
    assert found[-1, 2] == pytest.approx(0.05, abs=0.01)
    design = command("estimate", "model.toml", "off.csv", "--set", bias, "--set", payload)["design"]
    assert "does not estimate the bias of [measurement] and the parameters of [uncertainty]" in design


@pytest.mark.exhaustive
def test_a_run_keeps_what_is_asked_for():
    """What a long log takes in memory: a few numbers a row, and none for what no output shows."""
    model = load("model.toml").model
    record = logs.read("log.csv", logs.Columns(q=("angle",), u=("torque",))).record
    observer = EKF(model, jnp.eye(1), 1e-6 * jnp.eye(1))
    few, all_of_it = run(observer, record, KEPT), run(observer, record)
    assert few.info.innovation_cov is None
    assert sum(leaf.nbytes for leaf in jax.tree.leaves(few)) <= 60 * len(record.t)
    for name in ("innovation", "nis", "velocity_std", "result"):
        np.testing.assert_array_equal(getattr(few.info, name), getattr(all_of_it.info, name))


@pytest.mark.exhaustive
def test_a_simulated_drive_lags_as_the_model_file_says(tmp_path, monkeypatch):
    """The log holds what is commanded; the machine feels it later, by `[inputs] delay` and behind `[inputs] lag`."""
    monkeypatch.chdir(tmp_path)
    Path("model.toml").write_text(MODEL + "[inputs]\nlag = 0.05\ndelay = 0.02\n")
    command("simulate", "model.toml", "-o", "log.csv", "--duration", "4", "--rate", "500", "--amplitude", "2")
    errors = {}
    for name, told in (("told", ()), ("untold", ("--set", "inputs.lag=0.0", "--set", "inputs.delay=0.0"))):
        arguments = "estimate", "model.toml", "log.csv", "-o", f"{name}.csv", "--truth", "true_v1", *told
        errors[name] = command(*arguments)["velocity_rmse"][0]
    assert errors["told"] < 0.05 * errors["untold"]


@pytest.mark.exhaustive
def test_estimate_writes_joint_states_with_velocities(tmp_path):
    log, table, messages = (str(tmp_path / name) for name in ("log.csv", "run.csv", "run.mcap"))
    command("simulate", "oscillator", "--duration", "0.5", "--rate", "100", "--q0", "1", "-o", log)
    given = ("estimate", "oscillator", log, "--alpha", "40", "--beta", "800", "--engine", "jax")
    command(*given, "-o", table)
    command(*given, "-o", messages)
    drawn = np.asarray(logs.survey(table).columns["v"], float)
    assert len(drawn) == 51
    (velocity,) = (each for name, each in logs.survey(messages).columns.items() if name.endswith("/velocity"))
    np.testing.assert_allclose(velocity, drawn, rtol=1e-12)
