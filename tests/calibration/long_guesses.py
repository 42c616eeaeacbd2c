"""Numbers of a model that are far off, beside units, signs, curves and delays: what takes long."""

import numpy as np
import pytest
from test_guesses import GUESSED, NUMBERS, found, log, stated

from covariant.calibration.diagnosis import misread_input
from covariant.models import family, load


@pytest.mark.parametrize(
    ("what", "spoil"),
    [
        ("unit of time", lambda r: r._replace(t=1e3 * r.t)),
        ("unit of positions", lambda r: r._replace(y=np.rad2deg(r.y))),
        ("unit of an input", lambda r: r._replace(u=1e3 * r.u)),
        ("sign of an input", lambda r: r._replace(u=-r.u)),
    ],
)
def test_a_unit_or_a_sign_is_named_before_the_numbers(what, spoil):
    findings = [each.what for each in found(spoil(log()))]
    assert findings[0] == what
    assert set(findings) <= {what, NUMBERS}


def dead(u):
    return u - np.clip(u, -0.08, 0.08)


def limited(u):
    return np.clip(u, -0.3, 0.3)


@pytest.mark.parametrize(
    ("what", "curve", "value"),
    [("dead band of an input", dead, 0.08), ("limit of an input", limited, 0.3)],
)
def test_a_curve_is_found_beside_numbers_that_are_off(what, curve, value):
    findings = found(log(lambda u: np.stack([curve(u[:, 0]), u[:, 1]], axis=1)))
    assert (findings[0].what, findings[0].where) == (what, "u1")
    number = next(abs(findings[0].numbers[each]) for each in ("dead", "limit", "high") if each in findings[0].numbers)
    assert abs(number / value - 1) < 0.1
    assert {each.what for each in findings[1:]} <= {NUMBERS}


def test_fit_finds_a_curve_that_its_numbers_hide():
    record = log(lambda u: np.stack([dead(u[:, 0]), u[:, 1]], axis=1))
    guessed = load("pendulum_chain", stated(GUESSED))
    names = [f"{name}[{i}]" for name in GUESSED for i in range(2)]
    finding = misread_input(guessed, guessed, record, family("pendulum_chain", names, stated(GUESSED)))
    assert finding is not None
    assert finding.what == "dead band of an input"


def test_late_inputs_are_found_beside_numbers_that_are_off():
    findings = [each.what for each in found(log(late=4))]
    assert "delay against the inputs" in findings
    assert set(findings) <= {"delay against the inputs", NUMBERS}
