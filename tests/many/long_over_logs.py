"""What takes long of `test_over_logs.py`."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import leave
from test_over_logs import logs

import covariant
from covariant import many, verbs
from covariant.verbs.base.among_logs import LogRow, among_logs
from covariant.verbs.base.model_output import model_hash

NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.2}


def test_each_log_has_its_row_or_its_reason_and_the_rest_is_done(logs, tmp_path):
    asked = ("check", "oscillator", *logs, "--set", "measurement.std=1e-3", "-o", tmp_path / "out")
    code, out, _ = leave(*asked, "--workers", "1", "--json")
    assert code == 1
    result = json.loads(out)
    rows = {row["log"].rpartition("/")[2]: row for row in result["logs"]}
    assert [rows[f"log{k}.csv"]["verdict"] for k in range(4)] == ["ok", "ok", "ok", "WRONG"]
    assert rows["log3.csv"]["wrong"] == "unit of time"
    assert {name for name, row in rows.items() if "failed" in row} == {"broken.csv", "folder"}
    assert all("\n" not in reason for reason in result["failed"].values())
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"cases", "check.csv", "check.html"}


def test_a_bug_with_one_log_is_shown_as_one_and_the_others_go_on(logs, monkeypatch):
    estimate = verbs.estimate

    def fails(model, log, **settings):
        if str(log).endswith("log1.csv"):
            raise ValueError("min() iterable argument is empty")
        return estimate(model, log, **settings)

    monkeypatch.setattr(verbs, "estimate", fails)
    asked = ("estimate", "oscillator", *logs[2:4], logs[1], "--alpha", "40", "--beta", "800")
    code, out, error = leave(*asked, "--workers", "1", "--json")
    assert code == 70
    assert set(json.loads(out)["failed"]) == {str(logs[1]), str(logs[3])}
    assert "Traceback" in error
    assert "in fails" in error
    assert "is a bug of covariant" in error


@pytest.mark.exhaustive
def test_a_run_goes_on_by_the_content_of_logs_model_and_settings(logs, tmp_path):
    names = []
    for path in logs[2:5]:
        names.append(shutil.copy(path, tmp_path))
    settings = {"overrides": NOISE, "out": tmp_path / "out", "alpha": 40.0, "beta": 800.0}

    def run(**changed):
        called = []
        told = {"progress": lambda description, fraction=None: called.append(description)}
        return many.over_logs("estimate", "oscillator", names, **settings | changed | told), called[0]

    first, began = run()
    assert began == "estimate: 0 of 3 logs"
    again, began = run()
    assert began == "estimate: 3 of 3 logs"
    assert again.each == first.each
    shutil.copy(logs[2], names[1])
    (tmp_path / "out" / first.each[2].row["file"]).unlink()
    changed, began = run()
    assert began == "estimate: 1 of 3 logs", "one has another content, one has lost its file"
    assert [changed.each[k] == first.each[k] for k in range(3)] == [True, False, True]
    assert changed.columns["innovation_rms1"][1] == changed.columns["innovation_rms1"][0]
    assert run(alpha=50.0)[1] == "estimate: 0 of 3 logs"
    assert run()[1] == "estimate: 0 of 3 logs", "its files are those of the other gain"
    smoothed = many.over_logs("smooth", "oscillator", names[:1], overrides=NOISE, out=tmp_path / "out")
    assert smoothed.each[0].row["file"] != first.each[0].row["file"], "verbs share a folder"
    assert run()[1] == "estimate: 3 of 3 logs"
    Path(names[0]).write_bytes(b"no log")
    assert set(run()[0].failed) == {str(names[0])}
    assert not (tmp_path / "out" / first.each[0].row["file"]).exists(), "it is of a log that is no more"
    shutil.copy(logs[2], names[0])
    alone = covariant.estimate("oscillator", names[0], overrides=NOISE, alpha=40.0, beta=800.0)
    assert first.each[0].row["innovation_rms1"] == alone.summary["innovation_rms"][0]
    together = covariant.estimate("oscillator", names, overrides=NOISE, alpha=40.0, beta=800.0)
    assert together.columns["rows"].tolist() == [501.0] * 3


def test_the_file_of_a_log_depends_on_no_other_log(logs, tmp_path):
    """Logs that are added later, and folders that are moved together, leave its name and its row."""
    for machine in ("arm", "other/arm"):
        (tmp_path / "lab" / machine).mkdir(parents=True)
        shutil.copy(logs[2], tmp_path / "lab" / machine / "log.csv")
    shutil.copy(logs[3], tmp_path / "lab" / "arm" / "log.txt")
    called = []

    def run(lab, *names):
        called.clear()
        paths = [lab / name for name in names]
        settings = {"alpha": 40.0, "beta": 800.0, "progress": lambda *said: called.append(said[0])}
        result = many.over_logs("estimate", "oscillator", paths, out=lab / "out", **settings)
        return [row["file"] for _, row in result.each], called[0]

    names = ("arm/log.csv", "other/arm/log.csv", "arm/log.txt")
    (alone,), _ = run(tmp_path / "lab", names[0])
    assert re.fullmatch(r"arm_log_[0-9a-f]{8}\.parquet", alone)
    files, began = run(tmp_path / "lab", *names[::-1], names[0])
    assert began == "estimate: 1 of 3 logs"
    assert files[2:] == [alone, alone]
    assert len(set(files)) == 3
    (tmp_path / "lab").rename(tmp_path / "moved")
    assert run(tmp_path / "moved", *names) == (files[2::-1], "estimate: 3 of 3 logs")


@pytest.mark.parametrize("model", ["arm.toml", "arm:made", "robot.xml"])
def test_the_hash_of_a_model_is_of_all_files_that_it_is_read_from(tmp_path, monkeypatch, model):
    monkeypatch.chdir(tmp_path)
    files = {
        "arm.toml": 'system = "arm:made"',
        "arm.py": "import numpy\nimport helper\n",
        "helper.py": "from parts.link import MASS\n",
        "parts/__init__.py": "",
        "parts/link.py": "MASS = 1.0\n",
        "robot.xml": '<mujoco><compiler meshdir="meshes"/><include file="leg.xml"/></mujoco>',
        "leg.xml": '<mujoco><asset><mesh name="foot" file="foot.stl"/></asset></mujoco>',
        "foot.stl": "solid",
    }
    for name, text in files.items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    before = model_hash(model)
    beside = {"arm.toml": "arm.toml", "arm:made": "arm.py", "robot.xml": "leg.xml"}[model]
    for name in (beside, "foot.stl" if model == "robot.xml" else "parts/link.py"):
        text = Path(name).read_text()
        Path(name).write_text(text + " ")
        assert model_hash(model) != before
        Path(name).write_text(text)
        assert model_hash(model) == before


@pytest.mark.exhaustive
def test_processes_find_what_one_finds(logs, tmp_path):
    said = []

    def check(workers):
        settings = {"overrides": NOISE, "progress": lambda *line: said.append(line)}
        return many.over_logs("check", "oscillator", logs, workers=workers, **settings)

    assert check(1).each == check(2).each
    assert said[-1] == ("check: 6 of 6 logs, 2 failed, 0 s left", 1.0)


@pytest.mark.parametrize("between", [0.0, 0.01, 0.1])
def test_an_odd_machine_of_a_few_is_named_and_spoils_nothing(between):
    """Ten spreads off, among ten; and chance is no odd machine."""
    rng = np.random.default_rng(0)

    def fleet(off):
        size = np.hypot(between, 0.01)
        means = 1.0 + between * rng.normal(size=10) + np.where(np.arange(10) == 4, off * size, 0.0)
        rows = [
            LogRow(f"arm{k % 10}/log{k // 10}.csv", {"mass": means[k % 10] + 0.01 * rng.normal(), "mass_std": 0.01})
            for k in range(20)
        ]
        return among_logs(rows).sentences

    odd = [fleet(12.0) for _ in range(50)]
    assert sum(len(lines) == 2 and lines[1].startswith("  arm4: +") for lines in odd) >= 48
    shared = [float(lines[0].split()[2]) for lines in odd]
    assert abs(np.mean(shared) - 1.0) < 0.3 * np.hypot(between, 0.01)
    assert sum(len(fleet(0.0)) > 1 for _ in range(200)) <= 2
