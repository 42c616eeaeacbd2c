"""A log that is changed on purpose is found to be so, and one that fits is left in peace."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.calibration import diagnose, misfit
from covariant.calibration._changes import Names, no_change
from covariant.logs import unit_factor
from covariant.models import load
from covariant.signals import Record
from covariant.simulation import Sensor, sense, simulate, stamps

LONG = ("test_a_log_that_fits_has_no_findings[0]",)
"""Cases of the long suite: a cheaper one of the same test, or of the same law, is in the short one."""

SPACING = 2e-3
QUANTUM = 1.5339807878856412e-3


@pytest.fixture(scope="module")
def pendulum():
    """A driven double pendulum whose model file gives the deviation of noise, as `load` of the demonstration's does."""
    file = load("examples/demo_double_pendulum.toml", ("measurement.std=2e-4",))
    return file._replace(columns=file.columns._replace(q=("q1", "q2"), u=("tau1", "tau2")))


def torques(t, x):
    return jnp.stack([0.4 * jnp.sin(7.0 * t), 0.2 * jnp.sin(4.0 * t + 1.0)])


@pytest.fixture(scope="module")
def exact(pendulum):
    """Its motion, without noise, from a start: the program is compiled once."""
    t = stamps(Sensor(1 / SPACING), 6.0)

    def moved(*start: float) -> Record:
        record = simulate(pendulum.model, jnp.array(start), jnp.asarray(t), torques, rtol=1e-7, atol=1e-9)
        return Record(t, np.asarray(record.u), np.asarray(record.y))

    return moved


@pytest.fixture(scope="module")
def clean(exact):
    record = exact(0.5, -0.8, 1.0, 2.0)
    return record._replace(y=sense(Sensor(500.0, noise_std=2e-4), record.y, 3))


def late(column, time, t):
    return np.interp(t - time, t, column)


def one_late(record, joint, time):
    y = record.y.copy()
    y[:, joint] = late(y[:, joint], time, record.t)
    return record._replace(y=y)


def whats(done):
    return [finding.what for finding in done.findings if finding.wrong]


@pytest.mark.parametrize("seed", range(4))
def test_a_log_that_fits_has_no_findings(pendulum, exact, seed):
    record = exact(*np.random.default_rng(seed).uniform(-2, 2, 4))
    record = record._replace(y=sense(Sensor(500.0, noise_std=2e-4), record.y, seed))
    assert diagnose(pendulum, record).findings == ()
    assert misfit(pendulum, record) is None


CHANGES = {
    "milliseconds": (lambda r: r._replace(t=r.t * 1e3), "unit of time", '[units] t = "ms"'),
    "seconds taken for milliseconds": (lambda r: r._replace(t=r.t * 1e-3), "unit of time", '[units] t = "1e+03 s"'),
    "nanoseconds": (lambda r: r._replace(t=r.t * 1e9), "unit of time", '[units] t = "ns"'),
    "degrees": (lambda r: r._replace(y=np.rad2deg(r.y)), "unit of positions", '[units] q = "deg"'),
    "turns": (lambda r: r._replace(y=r.y / (2 * np.pi)), "unit of positions", '[units] q = "turn"'),
    "both": (
        lambda r: r._replace(t=r.t * 1e3, y=np.rad2deg(r.y)),
        "unit of time and positions",
        '[units] t = "ms"; [units] q = "deg"',
    ),
    "counts": (
        lambda r: r._replace(y=np.round(r.y / (2 * np.pi) * 16384)),
        "unit of positions",
        '[units] q = "turn/16384"',
    ),
    "one joint in degrees": (
        lambda r: r._replace(y=r.y * [1.0, 180 / np.pi]),
        "unit of positions",
        '[units] q = ["rad", "deg"]',
    ),
    "swapped joints": (lambda r: r._replace(y=r.y[:, ::-1], u=r.u[:, ::-1]), "swapped joints", 'u = ["tau2", "tau1"]'),
    "swapped positions": (lambda r: r._replace(y=r.y[:, ::-1]), "swapped positions", '[columns] q = ["q2", "q1"]'),
    "swapped torques": (lambda r: r._replace(u=r.u[:, ::-1]), "swapped inputs", '[columns] u = ["tau2", "tau1"]'),
    "sign of a torque": (lambda r: r._replace(u=r.u * [-1, 1]), "sign of an input", '[units] u = ["-1", "1"]'),
    "sign of a position": (
        lambda r: r._replace(y=r.y * [1, -1]),
        "sign of a position",
        '[units] q = ["rad", "-1 rad"]',
    ),
    "upside down": (lambda r: r._replace(y=r.y + np.array((np.pi, 0.0))), "zero of a position", "add 3.14159265 to q1"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_a_column_is_in_truth_is_found(pendulum, clean, name):
    change, what, line = CHANGES[name]
    changed = change(clean)
    found = [finding for finding in diagnose(pendulum, changed).findings if finding.wrong]
    assert [finding.what for finding in found] == [what]
    assert line in found[0].line
    if what.startswith("unit") and "one joint" not in name:
        refused = misfit(pendulum, changed)
        assert refused is not None
        assert refused.line == found[0].line


LOGGED = Names("t", ("a", "b"), ("x", "y"), ("rad", "m"), np.array([True, False]))


@pytest.mark.parametrize(
    ("stated", "field", "factors", "line"),
    [
        ({}, "q", [np.pi / 180, 1.0], '[units] q = ["deg", "m"]'),
        ({"q": ("deg", "mm")}, "q", [180 / np.pi, 1.0], '[units] q = ["rad", "mm"]'),
        ({"q": ("deg",)}, "q", [-1.0, -1.0], '[units] q = "-1 deg"'),
        ({"q": ("turn/4096", "m")}, "q", [0.25, 1.0], '[units] q = ["turn/16384", "m"]'),
        ({"t": ("ms",)}, "t", [1e3], '[units] t = "s"'),
        ({"u": ("-1 N m", "N")}, "u", [-1.0, 0.5], '[units] u = ["N m", "0.5 N"]'),
        ({"u": ("mN m",)}, "u", [0.5, 1.0], '[units] u = ["0.5 mN m", "mN m"]'),
    ],
)
def test_the_line_of_units_counts_from_what_the_file_says(stated, field, factors, line):
    names = LOGGED._replace(stated=stated)
    assert names.line(field, factors) == line
    before = [unit_factor(names.in_units(field, np.ones(len(factors)))[i]) for i in range(len(factors))]
    after = [unit_factor(text) for text in names.in_units(field, factors)]
    np.testing.assert_allclose(after, np.array(before) * factors, rtol=1e-12)


def test_after_a_change_columns_and_units_are_those_that_it_asks_for():
    change = no_change(2, 2)._replace(order=np.array([1, 0]), inputs=np.array([-1.0, 1.0]))
    names = LOGGED._replace(stated={"u": ("N m", "N")}, angles=np.array([True, True])).after(change)
    assert names.q == ("b", "a")
    assert names.stated["u"] == ("-1 N m", "N")
    assert names.line("u", [-1.0, 1.0]) == '[units] u = ["N m", "N"]'


@pytest.mark.parametrize(("joint", "time"), [(0, SPACING), (1, SPACING), (1, 30e-3)])
def test_a_late_joint_is_found_to_half_a_millisecond(pendulum, clean, joint, time):
    (found,) = diagnose(pendulum, one_late(clean, joint, time)).findings
    assert (found.what, found.where) == ("delay", ("q1", "q2")[joint])
    assert abs(found.numbers["delay"] - time) < 3e-4
    assert found.numbers["std"] < 2e-4
    if time == SPACING:
        assert "1 row late" in found.evidence
    given = [float(x) for x in found.line.split("[")[-1].rstrip("]").split(",")]
    np.testing.assert_allclose(given, np.where(np.arange(2) == joint, found.numbers["delay"], 0), atol=1e-4)
    assert misfit(pendulum, one_late(clean, joint, time)) is None
    told = pendulum._replace(delay=tuple(given))
    assert [finding.what for finding in diagnose(told, one_late(clean, joint, time)).findings if finding.wrong] == []


@pytest.mark.parametrize("time", [10e-3, -10e-3])
def test_a_delay_of_all_positions_shows_against_the_inputs(pendulum, clean, time):
    moved = clean._replace(u=np.array([late(column, -time, clean.t) for column in clean.u.T]).T)
    (found,) = diagnose(pendulum, moved).findings
    assert found.what == "delay against the inputs"
    assert abs(found.numbers["delay"] - time) < 2e-3  # whether an input acts from or around its stamp is not known
    assert ("[inputs] lag = 0.0" in found.line) if time > 0 else ("subtract" in found.line)


def test_the_scale_of_an_input_is_found(pendulum, clean):
    (found,) = diagnose(pendulum, clean._replace(u=clean.u * [1.0, 2.0])).findings
    assert (found.what, found.where) == ("scale of an input", "tau2")
    assert abs(found.numbers["scale"] - 0.5) < 0.01 + 3 * found.numbers["std"]


@pytest.mark.parametrize("scales", [(0.02, -0.05), (1.6, 0.5)])
def test_wrong_scales_of_all_inputs_do_not_hide_each_other(pendulum, clean, scales):
    """As where torques of motors are taken for those of the joints."""
    first, second = diagnose(pendulum, clean._replace(u=clean.u * scales)).findings
    for found, name, scale in ((first, "tau1", scales[0]), (second, "tau2", scales[1])):
        assert (found.what, found.where) == ("scale of an input", name)
        assert abs(found.numbers["scale"] * scale - 1) < 0.02 + 3 * found.numbers["std"] * abs(scale)


def test_two_faults_are_found_one_after_the_other(pendulum, clean):
    changed = one_late(clean, 1, 6e-3)._replace(t=clean.t * 1e3)
    done = diagnose(pendulum, changed._replace(u=clean.u * [1.0, 1.6]))
    assert whats(done) == ["unit of time", "delay", "scale of an input"]


def test_ticks_are_found_and_told_only_where_the_file_does_not_know_them(pendulum, exact):
    record = exact(0.5, -0.8, 1.0, 2.0)
    record = record._replace(y=sense(Sensor(500.0, quantum=QUANTUM), record.y))
    (found,) = diagnose(pendulum, record).findings
    assert found.what == "ticks"
    assert not found.wrong
    assert abs(found.numbers["quantum"] / QUANTUM - 1) < 1e-6
    first = re.fullmatch(
        r"covariant fit MODEL LOG --parameters rotor_inertia --set 'parameters.rotor_inertia=\[(.*), (.*)\]'",
        found.line,
    )
    assert first is not None
    # That of the other joint is a tenth of it, for a fit to start from.
    assert np.isclose(float(first[1]), 10 * float(first[2]), rtol=0.05)
    refused = misfit(fault.file, fault.record)
    assert refused is not None
    assert refused.what == "rotor inertia"
