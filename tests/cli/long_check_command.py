"""`covariant check`, and the commands that refuse a log which does not fit the model at all."""

import csv
import json
import sys
from pathlib import Path

import pytest
from commands import command

from covariant.cli import main

MODEL = """
system = "pendulum_chain"
[parameters]
mass = [1.0]
length = [0.5]
viscous = [0.05]
[columns]
q = ["angle"]
u = ["torque"]
[measurement]
quantum = 1e-3
[uncertainty]
acceleration = 1.0
"""


def run(*arguments: str) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["covariant", *arguments])
        with pytest.raises(SystemExit) as left:
            main()
    return int(left.value.code or 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A simulated log, and the same in milliseconds."""
    folder = tmp_path_factory.mktemp("check")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("model.toml").write_text(MODEL)
        command(
            *("simulate", "model.toml", "-o", "log.csv", "--duration", "4", "--rate", "200", "--quantum", "1e-3"),
            *("--v0", "4", "--amplitude", "0.5"),
        )
        with Path("log.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        with Path("ms.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, rows[0])
            table.writeheader()
            table.writerows(row | {"t": str(1e3 * float(row["t"]))} for row in rows)
    return folder


@pytest.fixture(autouse=True)
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)


@pytest.mark.exhaustive
def test_a_log_that_fits_is_told_to(capsys):
    assert run("check", "model.toml", "log.csv") == 0
    text = capsys.readouterr().out
    assert text.startswith("OK: nothing wrong (0 notes, ")
    assert "\nlooked for: clock, missing rows" in text
    assert "801 rows at 200 Hz" in text


def test_what_is_wrong_is_printed_with_the_remedy(capsys):
    assert run("check", "model.toml", "ms.csv") == 1
    text = capsys.readouterr().out
    assert text.startswith("WRONG: the log is not what the model file says it is (1 wrong, ")
    assert "WRONG unit of time" in text
    assert '-> [units] t = "ms"' in text
    assert run("check", "model.toml", "ms.csv", "--json") == 1
    result = json.loads(capsys.readouterr().out)
    assert result["wrong"] is True
    assert [finding["what"] for finding in result["findings"]] == ["unit of time"]
    assert result["findings"][0]["numbers"]["unexplained_after"] < 0.01


def test_estimate_and_compare_refuse_such_a_log_unless_told_to_go_on(capsys):
    for name in ("estimate", "compare"):
        assert run(name, "model.toml", "ms.csv") == 1
        text = " ".join(capsys.readouterr().err.split())
        assert "with milliseconds" in text
        assert "`covariant check model.toml ms.csv` looks closer, and --anyway goes on" in text
    assert run("estimate", "model.toml", "ms.csv", "--alpha", "0.01", "--beta", "1e-4", "--anyway") in (0, 2)


def test_a_state_space_model_is_named(capsys):
    assert run("check", "lorenz", "log.csv") == 2
    assert "logs are compared with mechanical ones" in capsys.readouterr().err
