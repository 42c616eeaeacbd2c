"""A log that is changed on purpose is found to be so, and one that fits is left in peace."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.calibration import diagnose, misfit, outliers, suggest_noise
from covariant.calibration.diagnosis._case import busiest
from covariant.calibration.diagnosis._finding import Names
from covariant.calibration.diagnosis._servo_errors import independent_parts
from covariant.calibration.diagnosis._smooth import smooth
from covariant.calibration.diagnosis._suspicion import BLOCKS, Comparison, Unexplained
from covariant.logs import unit_factor
from covariant.models import load
from covariant.signals import Record
from covariant.simulation import PositionSensor, sense, simulate, stamps

SPACING = 2e-3


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
    t = stamps(PositionSensor(1 / SPACING), 6.0)

    def moved(*start: float) -> Record:
        record = simulate(pendulum.model, jnp.array(start), jnp.asarray(t), torques, rtol=1e-7, atol=1e-9)
        return Record(t, np.asarray(record.u), np.asarray(record.y))

    return moved


@pytest.fixture(scope="module")
def clean(exact):
    record = exact(0.5, -0.8, 1.0, 2.0)
    return record._replace(y=sense(PositionSensor(500.0, noise_std=2e-4), record.y, 3))


def late(column, time, t):
    return np.interp(t - time, t, column)


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
    names = LOGGED._replace(stated={"u": ("N m", "N")}, angles=np.array([True, True]))
    factors = {"q": np.ones(2), "u": np.array([-1.0, 1.0])}
    names = names.after({"t": [0], "q": [1, 0], "u": [0, 1]}, factors)
    assert names.q == ("b", "a")
    assert names.stated["u"] == ("-1 N m", "N")
    assert names.line("u", [-1.0, 1.0]) == '[units] u = ["N m", "N"]'


@pytest.mark.parametrize("time", [10e-3, -10e-3])
def test_a_delay_of_all_positions_shows_against_the_inputs(pendulum, clean, time):
    moved = clean._replace(u=np.array([late(column, -time, clean.t) for column in clean.u.T]).T)
    (found,) = diagnose(pendulum, moved).findings
    assert found.what == "delay against the inputs"
    assert abs(found.numbers["delay"] - time) < 2e-3  # whether an input acts from or around its stamp is not known
    assert ("[inputs] lag = 0.0" in found.line) if time > 0 else ("subtract" in found.line)


@pytest.mark.parametrize("apart", [1, 2, 3, 4])
@pytest.mark.parametrize("sign", [1, -1])
def test_outliers_beside_each_other_are_told_from_what_is_between_them(apart, sign):
    t = np.arange(0, 2, 0.002)
    y = np.sin(3 * t)[:, None]
    wrong = np.zeros(y.shape, bool)
    wrong[[300, 300 + apart, 700]] = True
    y[300], y[300 + apart], y[700] = y[300] + 0.5, y[300 + apart] + 0.5 * sign, y[700] - 0.5
    np.testing.assert_array_equal(outliers(t, y, (0,))[0], wrong)


def test_of_other_models_the_stamps_are_looked_at():
    t = np.arange(100) * 0.01
    t[50:] += 0.05
    turned = [[[np.cos(x), -np.sin(x), 0.0], [np.sin(x), np.cos(x), 0.0], [0.0, 0.0, 1.0]] for x in t]
    record = Record(t, np.zeros((100, 0)), np.array(turned))
    done = diagnose(models.ModelFile("top", models.free_body((1.0, 2.0, 3.0))), record)
    assert [finding.what for finding in done.findings] == ["missing rows"]
    assert "units" not in done.looked_for
    assert misfit(models.ModelFile("lorenz", models.lorenz()), record) is None


def test_measured_accelerations_are_averages_of_the_true_ones():
    """Whatever the motion, so that comparing them with a model's has no error of smoothing."""
    t = np.arange(0.0, 3.0, 1e-3)
    log = smooth(Record(t, np.zeros((len(t), 0)), np.cos(20 * t)[:, None]), 0.08, ())
    true = -400 * np.cos(20 * log.t)
    averaged = np.convolve(true, log.kernel, "same")
    error = np.abs(log.a[log.used, 0] - averaged[log.used]).max()
    assert np.abs(true - averaged)[log.used].max() > 40
    assert error < 4
    np.testing.assert_allclose(log.kernel.sum(), 1.0, atol=1e-9)


@pytest.mark.core(2)
@pytest.mark.parametrize("rows", [2, 3, 4, 5, 6, 11, 49, 52, 60])
@pytest.mark.parametrize("missing", [False, True])
def test_short_logs_are_looked_at_as_far_as_they_go(pendulum, clean, rows, missing):
    record = Record(clean.t[:rows], clean.u[:rows], clean.y[:rows].copy())
    if missing:
        record.y[1::2] = np.nan
    done = diagnose(pendulum, record)
    assert "too little motion" in [found.what for found in done.findings] or rows == 2
    assert suggest_noise(pendulum._replace(measurement_std=None, acceleration_std=None), record) is not None


@pytest.mark.parametrize("first", [0, 7, 15])
def test_the_busiest_rows_are_those_in_which_it_moves(first):
    """At the beginning, within, and at the very end of a log."""
    y = np.concatenate([np.zeros(first), np.arange(5.0), np.full(15 - first, 4.0)])[:, None]
    chosen = busiest(Record(np.arange(20.0), np.zeros((20, 0)), y), 5)
    np.testing.assert_array_equal(chosen.t, first + np.arange(5.0))


def test_a_motion_of_hours_is_compared_as_well():
    t = np.arange(2000) * 30.0
    y = 7e6 * np.cos(1e-3 * t) + 50.0 * np.random.default_rng(0).normal(size=2000)
    file = models.ModelFile("orbit", models.oscillator(stiffness=1e-6), measurement_std=50.0)
    file = file._replace(columns=file.columns._replace(q=("q",), u=("u",)))
    done = diagnose(file, Record(t, np.zeros((2000, 1)), y[:, None]))
    assert done.findings == ()
    assert "accelerations" in done.looked_for


def test_checks_that_a_standstill_hides_are_named(pendulum, clean):
    still = clean._replace(y=np.tile(clean.y[:1], (len(clean.t), 1)))
    assert "delays" in diagnose(pendulum, still).skipped
    assert diagnose(pendulum, clean).skipped == ()


def test_velocities_of_a_machine_without_inputs_are_compared():
    t = np.arange(0.0, 10.0, 0.01)
    free = load("pendulum_chain", {"parameters.mass": [1.0], "parameters.length": [9.81], "parameters.actuated": []})
    free = free._replace(columns=free.columns._replace(q=("q1",), u=(), v=("v1",)))
    swing, speed = 0.05 * np.cos(t)[:, None], -0.05 * np.sin(t)[:, None]
    record = Record(t, np.zeros((len(t), 0)), swing + 1e-5 * np.random.default_rng(0).normal(size=swing.shape))
    assert not [each for each in diagnose(free, record, v=speed).findings if each.wrong]
    assert "unit of velocities" in {each.what for each in diagnose(free, record, v=np.rad2deg(speed)).findings}


@pytest.mark.parametrize(("motions", "passes"), [(None, True), (20, True), (3, False)])
def test_a_fall_is_evidence_as_often_as_a_log_has_motions(motions, passes):
    share, one = np.linspace(0.1, 0.12, BLOCKS)[:, None], np.ones(1)
    now = Unexplained(share, 0 * one, one > 0, None if motions is None else motions * one)
    assert Comparison.of(now, now._replace(blocks=share / 10)).passes("servo change") == passes
    # A fall that is nearly all in one part is one part's worth.
    single = np.where(np.arange(BLOCKS)[:, None] == 2, 3.0, 1e-2)
    parted = Comparison.of(now._replace(blocks=single), now._replace(blocks=single / 100))
    assert parted.passes("servo change") == (motions is None)


def test_motions_are_counted_by_their_autocorrelation():
    t = np.arange(0.0, 20.0, 0.01)
    sines = np.stack([np.sin(2 * np.pi * f * t) for f in (0.25, 1.0)], axis=1)
    counts = independent_parts(sines)
    assert counts == pytest.approx([15, 60], rel=0.1)  # π parts in each period
    assert independent_parts(np.random.default_rng(0).normal(size=(2000, 1))) > 500
    assert independent_parts(np.zeros((9, 1))) == 0.0
