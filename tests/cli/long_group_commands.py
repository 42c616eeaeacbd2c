"""The commands on systems on groups: attitudes and poses in, velocities out, whichever way they are written."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import command, unpacked
from scipy.spatial.transform import Rotation

from covariant import logs
from covariant.calibration import tuned_estimators
from covariant.verbs.base.inputs import Job, load

EXAMPLES = Path(__file__).parents[2] / "examples"
TOP, VEHICLE = str(EXAMPLES / "heavy_top.toml"), str(EXAMPLES / "underwater_vehicle.toml")
WXYZ = ("qw", "qx", "qy", "qz")
TORQUES = ("u1", "u2", "u3")
RATES = ("w1", "w2", "w3")
TWIST = ("surge", "sway", "heave", "roll_rate", "pitch_rate", "yaw_rate")
MATRIX = [f"r{i}{j}" for i in "123" for j in "123"]
TRUTH = ",".join(f"true_{name}" for name in RATES)


def column(path, *names):
    """Columns (T, k) of a file, NaN where a cell is empty."""
    return logs.read(path, logs.Columns(q=names)).record.y


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory):
    """A folder with the log of a driven top, and the same log written in every other way."""
    folder = tmp_path_factory.mktemp("groups")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        command(
            *("simulate", TOP, "-o", "log.csv", "--duration", "3", "--rate", "200", "--noise", "1e-3", "--seed", "2"),
            *("--q0", "0.5,0.2,0", "--v0", "0.5,1,8", "--amplitude", "0.2,0.1,0", "--dropout", "0.03"),
        )
        yield folder


@pytest.fixture(scope="module")
def estimated(folder):
    return command("estimate", TOP, "log.csv", "-o", "v.csv", "--truth", TRUTH, "--report", "report.html")


def rewrite(name: str, attitude: dict) -> Path:
    """The log again, its attitude in other columns."""
    t, u = column("log.csv", "t")[:, 0], column("log.csv", *TORQUES)
    truth = column("log.csv", *TRUTH.split(","))
    kept = {"t": t} | dict(zip(TORQUES, u.T, strict=True)) | dict(zip(TRUTH.split(","), truth.T, strict=True))
    logs.write(name, kept | attitude)
    return Path(name)


def job(log, *overrides: str) -> Job:
    return Job(TOP, Path(log), overrides, 1, None, {})


@pytest.mark.exhaustive
def test_simulate_writes_attitude_inputs_and_truth():
    q, true_q = column("log.csv", *WXYZ), column("log.csv", *(f"true_{name}" for name in WXYZ))
    lost = np.isnan(q).all(axis=1)
    assert 5 < lost.sum() < 40
    assert not np.isnan(q[~lost]).any()
    assert not lost[0]
    np.testing.assert_allclose(np.linalg.norm(true_q, axis=1), 1.0, atol=1e-12)
    start = Rotation.from_quat(true_q[0][[1, 2, 3, 0]])
    np.testing.assert_allclose(start.as_rotvec(), [0.5, 0.2, 0.0], atol=1e-12)
    turns = Rotation.from_quat(true_q[~lost][:, [1, 2, 3, 0]]).inv() * Rotation.from_quat(q[~lost][:, [1, 2, 3, 0]])
    assert np.std(turns.as_rotvec(), axis=0) == pytest.approx(1e-3, rel=0.15)
    np.testing.assert_allclose(column("log.csv", *TRUTH.split(","))[0], [0.5, 1.0, 8.0])


@pytest.mark.exhaustive
def test_the_truth_of_a_simulation_turns_the_body():
    """The true attitudes and the true body rates belong together."""
    t, w = column("log.csv", "t")[:, 0], column("log.csv", *TRUTH.split(","))
    q = Rotation.from_quat(column("log.csv", *(f"true_{name}" for name in WXYZ))[:, [1, 2, 3, 0]])
    middle = (w[1:] + w[:-1]) / 2 * np.diff(t)[:, None]
    np.testing.assert_allclose((q[:-1].inv() * q[1:]).as_rotvec(), middle, atol=2e-5)


@pytest.mark.exhaustive
def test_what_is_simulated_is_estimated(estimated):
    assert estimated["observer"] == "intrinsic"
    assert estimated["scored_against"] == "true velocity"
    assert max(estimated["velocity_rmse"]) < 0.03


@pytest.mark.exhaustive
def test_machines_get_the_documented_keys(estimated):
    assert list(estimated) == [
        *("model", "log", "observer", "rows", "engine", "scored_against", "design"),
        *("velocity_rmse", "velocity_median_error", "innovation_rms", "nis", "nees", "results", "report", "out"),
    ]
    lost = int(np.isnan(column("log.csv", "qw")).sum())
    assert estimated["rows"] == 601
    assert estimated["results"] == {"ok": 601 - lost, "coasted": lost}
    assert all(len(estimated[key]) == 3 for key in ("velocity_rmse", "innovation_rms"))


@pytest.mark.exhaustive
def test_the_estimate_has_the_columns_of_the_log_and_the_names_of_the_model(estimated):
    assert Path("v.csv").read_text().splitlines()[0] == "t,qw,qx,qy,qz,w1,w2,w3"
    q, true_q = column("v.csv", *WXYZ), column("log.csv", *(f"true_{name}" for name in WXYZ))
    assert np.isfinite(column("v.csv", *RATES)).all()
    assert np.abs(np.abs(np.einsum("ki,ki->k", q, true_q)) - 1)[200:].max() < 1e-5


@pytest.mark.exhaustive
def test_the_report_is_one_page_and_figures(estimated):
    assert [Path(p).suffix for p in estimated["report"]] == [".html", ".png", ".png", ".png"]
    figures = unpacked(Path("report.html").read_text(), "figures")
    assert "along w1 [rad]" in figures
    assert "dw1/dt" not in figures


def test_signs_and_rounding_of_quaternions_do_not_matter(estimated):
    q = column("log.csv", *WXYZ) * np.random.default_rng(0).choice([-1.01, 1.01, 1.0], (601, 1))
    rewrite("signs.csv", dict(zip(WXYZ, q.T, strict=True)))
    again = command("estimate", TOP, "signs.csv", "-o", "w.csv", "--truth", TRUTH)
    np.testing.assert_allclose(column("w.csv", *RATES), column("v.csv", *RATES), atol=1e-11)
    assert again["velocity_rmse"] == estimated["velocity_rmse"]


def test_every_way_to_write_the_attitude_is_the_same_record():
    plain = load(job("log.csv")).record.y
    q = column("log.csv", *WXYZ)
    rewrite("last.csv", dict(zip("wxyz", q.T, strict=True)))
    present = np.isfinite(q[:, 0])
    turns = np.full((601, 9), np.nan)
    turns[present] = Rotation.from_quat(q[present][:, [1, 2, 3, 0]]).as_matrix().reshape(-1, 9)
    rewrite("matrix.csv", dict(zip(MATRIX, turns.T, strict=True)))
    for log, override in (
        ("last.csv", 'columns.quaternion_xyzw=["x", "y", "z", "w"]'),
        ("last.csv", 'columns.quaternion_wxyz=["w", "x", "y", "z"]'),
        ("matrix.csv", f"columns.matrix={json.dumps(MATRIX)}"),
    ):
        np.testing.assert_allclose(load(job(log, override)).record.y, plain, atol=1e-14)


def test_without_a_truth_the_attitudes_themselves_are_the_reference():
    loaded = load(job("log.csv"))
    assert loaded.reference.label == "zero-phase reference"
    error = loaded.reference.v - column("log.csv", *TRUTH.split(","))
    assert np.sqrt(np.mean(error[loaded.reference.scored] ** 2, axis=0)).max() < 0.06
    assert load(job("log.csv"), score=False).reference is None
    some = load(job("log.csv")._replace(every=4, until=2.0))
    assert len(some.record.t) == 101
    np.testing.assert_allclose(some.reference.v, loaded.reference.v[:401:4], atol=1e-12)


@pytest.mark.exhaustive
def test_compare_ranks_what_fits(monkeypatch):
    quick = ("intrinsic", "salcudean")  # the others take a minute to compile; `design` tests that all are lined up

    def some(*arguments):
        return {name: observer for name, observer in tuned_estimators(*arguments).items() if name in quick}

    monkeypatch.setattr("covariant.verbs.base.kinds.tuned_estimators", some)
    result = command("compare", TOP, "log.csv", "--truth", TRUTH, "-o", "table.csv", "--every", "2", "--until", "2")
    names = [row["estimator"] for row in result["ranking"]]
    assert sorted(names) == sorted(quick)
    assert all(max(row["velocity_rmse"]) < 0.1 for row in result["ranking"])
    table = [line.split(",") for line in Path("table.csv").read_text().splitlines()]
    assert table[0] == ["rank", "estimator", "w1_rmse", "w2_rmse", "w3_rmse", "nis", "nees", "microseconds"]
    assert [row[1] for row in table[1:]] == names


@pytest.mark.exhaustive
def test_a_vehicle_is_simulated_and_estimated():
    command(
        *("simulate", VEHICLE, "-o", "pose.parquet", "--duration", "6", "--rate", "50", "--noise", "5e-3"),
        *("--q0", "1,2,-3,0.2,0,1", "--v0", "0.5,0,0,0,0,0.2", "--amplitude", "20,5,5,1,1,1", "--dropout", "0.05"),
    )
    truth = ",".join(f"true_{name}" for name in TWIST)
    result = command("estimate", VEHICLE, "pose.parquet", "-o", "twist.csv", "--truth", truth)
    pose = ("px", "py", "pz", "qx", "qy", "qz", "qw")
    assert Path("twist.csv").read_text().splitlines()[0] == ",".join(("t", *pose, *TWIST))
    assert max(result["velocity_rmse"]) < 0.06
    assert result["results"]["coasted"] == np.isnan(column("pose.parquet", "px")).sum() > 0
    off = column("twist.csv", *pose[:3]) - column("pose.parquet", *(f"true_{name}" for name in pose[:3]))
    assert np.abs(off[100:]).max() < 0.02
    loaded = load(Job(VEHICLE, Path("pose.parquet"), (), 1, None, {}))
    against = column("pose.parquet", *truth.split(","))
    assert np.sqrt(np.mean((loaded.reference.v - against)[loaded.reference.scored] ** 2, axis=0)).max() < 0.06
