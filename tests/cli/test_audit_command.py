"""`covariant audit`: what it prints, draws and returns."""

import json
import sys

import pytest

from covariant.cli import main

NAMES = ["plant", "error", "lyapunov", "metric", "torsion", "transport", "curvature", "invariance", "approximation"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command: exit code, standard output and standard error."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["covariant", "audit", *arguments])
        with pytest.raises(SystemExit) as left:
            main()
        return left.value.code or 0, *capsys.readouterr()

    return run


@pytest.mark.exhaustive
def test_a_sound_observer_passes_and_is_drawn(run, folder):
    code, out, _ = run(
        "oscillator", "--alpha", "2", "--beta", "3", "--points", "8", "--box", "q=1:2", "-o", "page.html"
    )
    assert code == 0
    lines = out.splitlines()
    assert lines[0] == "Intrinsic, α = 2 1/s, β = 3 1/s²: passed: 8 laws hold, 1 skipped"
    assert lines[1] == "8 states, 1 ≤ q ≤ 2 m, velocities to ±3 (seed 0)"
    assert [line.split()[1] for line in lines[2:-1]] == NAMES
    assert lines[-1] == "wrote page.html"
    page = (folder / "page.html").read_text(encoding="utf-8")
    assert "<title>Audit of oscillator: passed</title>" in page
    assert page.count("data:image/png;base64,") == 1
    assert "in one dimension nothing is curved" in page
    assert "http" not in page.replace("http-equiv", "")


@pytest.mark.exhaustive
def test_a_broken_law_is_exit_code_1(run, folder):
    """An observer that carries nothing along, in the chart r = exp(q) of the oscillator."""
    chart = ("--set", 'parameters.chart="r"')
    code, out, error = run("oscillator", *chart, "--observer", "copy", "--json", "--seed", "3", "-o", "figure.png")
    found = json.loads(out)
    assert code == 1
    assert not error
    assert found["passed"] is False
    assert found["observer"] == "copy"
    verdicts = {law["name"]: law["verdict"] for law in found["laws"]}
    assert list(verdicts) == NAMES
    failed = [name for name, verdict in verdicts.items() if verdict == "fails"]
    assert failed == ["error", "lyapunov", "invariance", "approximation"]
    worst = found["laws"][1]
    assert worst["deviation"] > worst["tolerance"]
    assert len(worst["point"]) == 2
    assert found["laws"][6]["deviation"] is None
    assert found["figure"] == "figure.png"
    assert (folder / "figure.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("oscillator", "--observer", "ekf"), "observer ekf does not fit oscillator"),
        (("oscillator", "--observer", "salcudean"), "these do: intrinsic, intrinsic2, intrinsic-force"),
        (("heavy_top", "--observer", "savitzky-golay"), "observer savitzky-golay does not fit heavy_top"),
        (("heavy_top", "--observer", "salcudean"), "Salcudean has no gains alpha and beta"),
        (("oscillator", "--alpha", "2"), "--alpha and --beta belong together"),
        (("oscillator", "--alpha", "2", "--beta", "-1"), "must be positive numbers"),
        (("oscillator", "--box", "q=1"), "does not have the form NAME=LOW:HIGH"),
        (("oscillator", "--box", "q=1:2,q=1:2"), "q is given twice"),
        (("oscillator", "--box", "r=1:2"), "unknown coordinate 'r'. Known: q"),
        (("oscillator", "--box", "q=2:1"), "the low end of q must be below the high one"),
        (("oscillator", "--speed", "0"), "speed must be a positive number"),
        (("oscillator", "-o", "page.txt"), "must end in .html"),
        (("lorenz",), "lorenz is a state-space model"),
        (("nothing",), "nothing"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(run, arguments, message):
    code, out, error = run(*arguments)
    assert code == 2
    assert not out
    assert error.startswith("covariant: ")
    assert error.count("\n") == 1
    assert message in error


@pytest.mark.parametrize("option", ["--points", "--seed"])
def test_counts_are_checked(run, option):
    assert run("oscillator", option, "-1")[0] == 2
