"""`covariant check`, and the commands that refuse a log which does not fit the model at all."""

import json
from pathlib import Path

import pandas
import pytest
from commands import command, leave, refused
from test_commands import MODEL


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
        log = pandas.read_csv("log.csv")
        log.assign(t=1e3 * log.t).to_csv("ms.csv", index=False)
    return folder


@pytest.fixture(autouse=True)
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)


@pytest.mark.exhaustive
def test_a_log_that_fits_is_told_to():
    code, text, _ = leave("check", "model.toml", "log.csv")
    assert code == 0
    assert text.startswith("OK: nothing wrong (0 notes, ")
    assert "\nlooked for: clock, missing rows" in text
    assert "801 rows at 200 Hz" in text


@pytest.mark.exhaustive
def test_what_is_wrong_is_printed_with_the_remedy():
    code, text, _ = leave("check", "model.toml", "ms.csv")
    assert code == 1
    assert text.startswith("WRONG: the log is not what the model file says it is (1 wrong, ")
    assert "WRONG unit of time" in text
    assert '-> [units] t = "ms"' in text
    code, text, _ = leave("check", "model.toml", "ms.csv", "--json")
    result = json.loads(text)
    assert (code, result["wrong"]) == (1, True)
    assert [finding["what"] for finding in result["findings"]] == ["unit of time"]
    assert result["findings"][0]["numbers"]["unexplained_after"] < 0.01


def test_estimate_and_compare_refuse_such_a_log_unless_told_to_go_on():
    closer = "`covariant check model.toml ms.csv` looks closer, and --anyway goes on"
    for name in ("estimate", "compare"):
        refused(name, "model.toml", "ms.csv", named=["with milliseconds", closer], code=1)
    arguments = ("estimate", "model.toml", "ms.csv", "--alpha", "0.01", "--beta", "1e-4", "--anyway")
    assert leave(*arguments).code in (0, 2)


def test_a_state_space_model_is_named():
    refused("check", "lorenz", "log.csv", named=["logs are compared with mechanical ones"])
