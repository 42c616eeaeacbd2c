"""Inputs that act by a curve, zeros that move, and runs of wrong readings are named, with the line that mends them."""

import numpy as np
import pytest
from test_causes import NOISE, TORQUE, T, pendulum, read, swing, wrong

from covariant.calibration import diagnose, outliers
from covariant.calibration.diagnosis._input_curves import Curve
from covariant.signals import Record

CURVES = {
    "offset of an input": (lambda u: u - 0.4, {"offset": 0.4}),
    "limit of an input": (lambda u: np.clip(u, -0.9, 0.9), {"limit": 0.9}),
    "dead band of an input": (lambda u: u - np.clip(u, -0.3, 0.3), {"dead": 0.3}),
}


@pytest.mark.parametrize("what", CURVES)
def test_the_curve_of_an_input_is_named_with_its_number(what):
    curve, numbers = CURVES[what]
    rough = pendulum(**{"parameters.viscous": [0.0], "parameters.mass": [1.15]})
    found = diagnose(rough, Record(T, TORQUE[:, None], read(swing(torque=curve(TORQUE))))).findings[0]
    assert (found.what, found.where, found.wrong) == (what, "u1", True)
    for name, value in numbers.items():
        assert abs(abs(found.numbers[name]) - value) < max(4 * found.numbers["std"][0], 0.01 * value)
    # The line is an expression that mends the column.
    expression = found.line.removeprefix("write ").removesuffix(" into the column u1 of the log")
    mended = eval(expression, {"numpy": np, "u1": TORQUE})
    np.testing.assert_allclose(mended, curve(TORQUE), atol=0.02)


def test_a_curve_is_an_expression_in_the_units_of_its_column():
    u = np.linspace(-2.0, 2.0, 41)
    for curve in (Curve(offset=-0.5), Curve(low=-1.0, high=1.0), Curve(dead=0.3), Curve(0.5, 0.2, 0.1, high=1.0)):
        written = curve._replace(sign=1.0).expression("tau", 1e-3)
        got = 1e-3 * eval(written, {"numpy": np, "tau": 1e3 * u})
        np.testing.assert_allclose(got, curve._replace(sign=1.0)(u), atol=1e-9)


@pytest.mark.parametrize("lost", [0.03, 0.0])
def test_a_zero_that_moves_is_named_and_taken_as_a_note_once_it_is_stated(lost):
    x = swing()
    steps = np.diff(x[:, 0], prepend=x[0, 0])
    moved = np.cumsum(np.where(x[:, 1] > 2.0, -lost * steps, 0.0)) if lost else 0.03 * T
    y = read(x) + moved[:, None]
    log = Record(T, TORQUE[:, None], y)
    found = [each for each in diagnose(pendulum(), log).findings if each.wrong]
    assert found[0].what == ("lost counts" if lost else "zero of a position")
    assert abs(found[0].numbers["moved"] - moved[-1]) < 0.2 * abs(moved[-1])
    assert found[0].line.startswith("[measurement] bias = ")
    assert "[measurement] bias_drift = " in found[0].line
    assert wrong(pendulum(**{"measurement.bias": 0.03, "measurement.bias_drift": 0.05}), log) == []


BURSTS = {
    "far": (6, lambda y, r: y + 1.3),
    "zeros": (4, lambda y, r: 0 * y - 2.0),
    "random": (8, lambda y, r: y + r.choice([-1, 1], y.shape) * r.uniform(1, 3, y.shape)),
    "two rows": (2, lambda y, r: y - 0.5),
    "long": (40, lambda y, r: y + 2.0),
}


@pytest.mark.parametrize("kind", BURSTS)
def test_runs_of_wrong_readings_are_named_and_the_rest_is_judged(kind):
    rows, change = BURSTS[kind]
    random, y = np.random.default_rng(0), read(swing())
    begins = (300, 700, 1200)
    for begin in begins:
        y[begin : begin + rows] = change(y[begin : begin + rows], random)
    assert np.flatnonzero(outliers(T, y, ())[0]).tolist() == [begin + k for begin in begins for k in range(rows)]
    found = diagnose(pendulum(), Record(T, TORQUE[:, None], y)).findings
    assert {each.what for each in found if each.wrong} <= {"outliers"}  # a note where they are few
    assert f"row 301 (1.2 s) to row {300 + rows} " in found[0].evidence


def test_a_motion_without_faults_has_no_runs_of_wrong_readings():
    random = np.random.default_rng(1)
    fast = np.repeat(random.uniform(-3, 3, 300), 5)[: len(T)]
    for torque in (TORQUE, fast):
        x = swing(torque=torque)[:, :1]
        for y in (
            x + NOISE * random.normal(size=x.shape),
            np.round(x / 0.05) * 0.05,
            x + 0.02 * random.normal(size=x.shape),
        ):
            assert not outliers(T, y, ())[0].any()
