"""What `check` asks for has been tried by `check` itself."""

import numpy as np
import pytest

import covariant
from covariant.calibration import Diagnosis, Finding
from covariant.verbs import _check

LINE = "[measurement] delay = [0.01] where measurements are late, or [inputs] lag = 0.01 where inputs act late"


@pytest.fixture
def log():
    return covariant.simulate("oscillator", duration=4.0, rate=100.0, q0=1.0, noise=1e-3).record


@pytest.mark.parametrize("survives", [True, False])
def test_a_line_after_which_the_same_is_wrong_is_not_offered(log, monkeypatch, survives):
    delay, late = Finding("delay", "q", "q is late", LINE, True, {}), []

    def diagnose(file, *rest):
        late.append(float(np.max(file.delay)))
        return Diagnosis(() if survives and late[-1] else (delay,), ())

    monkeypatch.setattr(_check, "diagnose", diagnose)
    (found,) = covariant.check("oscillator", log).findings
    assert late == [0.0, 0.01]
    assert found.evidence == delay.evidence
    assert (found.line == LINE) == survives


@pytest.mark.parametrize(
    ("line", "settings"),
    [
        ('[units] t = "ms"; [units] q = "deg"', {"units.t": "ms", "units.q": "deg"}),
        ('[units] u = ["-1", "1"], or [parameters] that make it so', {"units.u": ["-1", "1"]}),
        ('[columns] u = ["action[2]", "action[1]"]', {"columns.u": ["action[2]", "action[1]"]}),
        ("[measurement] period = 0.628318531", {"measurement.period": 0.628318531}),
        (
            "[parameters] gravity = 0, as the log has; covariant fit MODEL LOG --parameters viscous",
            {"parameters.gravity": 0},
        ),
        ("move the column q2 up by 1 row in the log, or [measurement] delay = [0, 0.1]", {}),
        ("log a motion", {}),
    ],
)
def test_lines_are_pasted_as_they_are_written(line, settings):
    assert _check._settings(line) == settings


def test_a_log_in_a_file_is_mended_by_what_it_asks_for(log, tmp_path):
    table = np.column_stack([1e3 * log.t, log.y, log.u])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,q,u1", comments="")
    found = covariant.check("oscillator", tmp_path / "log.csv").findings
    assert [each.line for each in found if each.wrong] == ['[units] t = "ms"']
