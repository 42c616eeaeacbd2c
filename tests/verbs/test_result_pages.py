"""Pages of results: the header that all have, lag, marks and pushes, and pages of results that are no curves."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

import covariant
from covariant.calibration import Diagnosis, Finding
from covariant.verbs._check import CheckResult
from covariant.verbs._fit import FitResult
from covariant.verbs.base.inputs import Job
from covariant.verbs.base.pages import lag, made


def text_of(path: Path) -> str:
    return re.sub(r"<script.*?</script>|<style.*?</style>|<[^>]*>", " ", path.read_text("utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("delay", [3e-3, -2e-3])
def test_lag_is_that_of_a_delayed_velocity_and_noise_does_not_change_it(delay):
    t = np.linspace(0.0, 10.0, 5001)
    v, late = (np.stack([np.sin(3 * at), 2 * np.cos(5 * at)], axis=1) for at in (t, t - delay))
    late += 0.01 * np.random.default_rng(0).standard_normal(late.shape)
    v[100] = np.nan
    np.testing.assert_allclose(lag(t, late, v, t > 1), delay, atol=2e-4)


def test_a_page_of_a_check_has_each_finding_with_what_to_do(tmp_path):
    finding = Finding("unit of time", "", "stamps are 20 apart", '[units] t = "ms"', True, {})
    result = CheckResult("oscillator", "log.csv", 501, 50.0, Diagnosis((finding,), ("clock", "ticks"), ()))
    [path] = result.report(tmp_path / "check.html")
    text = text_of(path)
    assert "unit of time" in text
    assert "[units] t = &quot;ms&quot;" in text
    assert "501 rows" in text
    assert f"covariant {covariant.__version__}, " in text


def test_a_page_of_a_fit_has_numbers_errors_and_what_is_not_determined(tmp_path):
    row = {"name": "stiffness", "before": 1.0, "after": 1.3, "standard_error": 0.01, "determined": True}
    errors = {"position": [2e-3], "velocity": [3e-2]}
    details = {
        "parameters": [row],
        "undetermined": ["only the ratio of mass and stiffness"],
        "better": True,
        "coordinates": ["q"],
        "units": ["m"],
        "held_out_errors": {"before": errors, "after": errors},
        "inputs": {"sentence": ""},
        "held_out": "other.csv",
        "fitted_to": "log.csv",
        "logs": ["log.csv", "other.csv"],
        "horizon": 0.5,
        "scored_against": "zero-phase reference",
        "each": [{"log": "a/b.csv", "elbow.offset": 0.12345, "elbow.offset_std": 0.011}, {"log": "c.csv"}],
    }
    [path] = FitResult([Job("oscillator", "log.csv")], {}, details).report(tmp_path / "fit.html")
    text = text_of(path)
    for part in ("stiffness = 1.3 ± 0.01", "Not determined: only the ratio", "held out", "position, after", "0.5 s of"):
        assert part in text
    assert re.search(r"Each log by itself.*elbow\.offset\s+b\.csv\s+0\.1235 ± 0\.011\s+c\.csv", text, re.DOTALL)


def test_a_command_line_of_hundreds_of_logs_is_shortened(monkeypatch):
    logs = [f"log {k}.csv" for k in range(100)]
    monkeypatch.setattr(sys, "argv", ["/bin/covariant", "check", "arm.toml", *logs, "-o", "out"])
    shortened = (
        "covariant check arm.toml 'log 0.csv' 'log 1.csv' 'log 2.csv' … (95 more) … 'log 98.csv' 'log 99.csv' -o out"
    )
    assert made()["command"] == shortened
    monkeypatch.setattr(sys, "argv", sys.argv[:4])
    assert made()["command"] == "covariant check arm.toml 'log 0.csv'"
