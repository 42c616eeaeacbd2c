"""Records: the one line that names what is wrong with one, and inputs passed through a lag."""

from typing import NamedTuple

import jax
import numpy as np
import pytest
from scipy import signal

from covariant.signals import Record, Run, StepCode, acting_inputs, lag_inputs, read_together

T = np.array([0.0, 0.1, 0.3, 0.4])
GOOD = Record(T, np.zeros((4, 1)), np.arange(8.0).reshape(4, 2))


def changed(field: str, row: int, value) -> Record:
    array = np.array(getattr(GOOD, field))
    array[row] = value
    return GOOD._replace(**{field: array})


def test_a_sound_record_comes_back_itself():
    assert GOOD.check() is GOOD
    gaps = changed("y", 2, np.nan)
    assert gaps.check() is gaps
    alone = GOOD._replace(u=np.empty((4, 0)))
    assert alone.check() is alone


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (GOOD._replace(t=T[:, None]), r"got \(4, 1\), \(4, 1\), \(4, 2\)"),
        (
            GOOD._replace(u=np.zeros(4)),
            r"needs t \(T,\), u \(T, m\), y \(T, n\) or \(T, N, N\); got \(4,\), \(4,\), \(4, 2\)",
        ),
        (GOOD._replace(y=np.zeros((3, 2))), r"got \(4,\), \(4, 1\), \(3, 2\)"),
        (Record(T[:1], np.zeros((1, 1)), np.zeros((1, 1))), "at least two rows; this one has 1"),
        (Record(T[:0], np.zeros((0, 1)), np.zeros((0, 1))), "at least two rows; this one has 0"),
        (changed("t", 2, np.nan), "row 3: t is not a finite number; only measurements may be missing"),
        (changed("t", 3, np.inf), "row 4: t is not a finite number"),
        (changed("u", 1, np.nan), "row 2: u is not a finite number"),
        (changed("u", 1, -np.inf), "row 2: u is not a finite number"),
        (changed("y", 1, np.inf), "row 2: a measurement is infinite; mark a missing one by NaN"),
        (changed("t", 2, 0.05), "row 3: time goes back from 0.1 s to 0.05 s; sort or split the log"),
        (changed("t", 2, 0.1), "rows 2 and 3 have the same stamp 0.1 s; keep one of them"),
        (GOOD._replace(t=np.array([30, 20, 10, 0], np.uint32)), "row 2: time goes back from 30 s to 20 s"),
        (GOOD._replace(y=np.ma.masked_array(GOOD.y, GOOD.y > 0)), r"positions y \(T, n\) are a masked array; fill"),
        (GOOD._replace(t=1e9 * T + 1.7e18), "stamps reach 1.7e[+]18 s, after the year 2200; they must be in seconds"),
        (
            GOOD._replace(t=np.float32(1e4) + np.float32(0.05) * np.arange(4, dtype=np.float32)),
            "stamps in float32 near 10000.2 s are",
        ),
        (GOOD._replace(y=GOOD.y > 0), r"positions y \(T, n\) are true and false; they must be numbers"),
        (GOOD._replace(u=GOOD.u * 1j), r"inputs u \(T, m\) are complex; they must be real numbers"),
        (GOOD._replace(t=T + 0j), r"stamps t \(T,\) are complex; they must be real numbers"),
        (GOOD._replace(t=np.array([0.0, 0.1, 0.1, 0.05])), "row 4: time goes back"),  # before equal stamps
        (changed("y", 0, np.nan), "row 1 lacks a measurement, so no estimate can start there"),
        (changed("y", 0, [0.0, np.nan]), "row 1 lacks a measurement"),
    ],
)
def test_what_is_wrong_is_named(record, words):
    with pytest.raises(ValueError, match=words) as caught:
        record.check()
    assert "\n" not in str(caught.value)


def test_every_result_has_its_sentence():
    assert len({result.message for result in StepCode}) == len(StepCode)
    assert StepCode.OK == 0


def test_a_lag_answers_a_step_by_an_exponential_whatever_the_stamps():
    t = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.05, 60))
    u = np.ones((60, 2)) * [1.0, -3.0]
    u[0] = 0.0
    lagged = lag_inputs(Record(t, u, np.zeros((60, 1))), 0.2)
    np.testing.assert_allclose(lagged.u, (1 - np.exp(-(t - t[0]) / 0.2))[:, None] * [1.0, -3.0], rtol=0, atol=1e-12)
    assert u[1, 0] == 1.0, "the record given must stay as it was"
    np.testing.assert_array_equal(lagged.t, t)


def test_a_lag_is_the_filter_of_scipy_on_regular_stamps():
    u = np.random.default_rng(1).normal(size=80)
    keep = np.exp(-0.01 / 0.03)
    expected, _ = signal.lfilter([1 - keep], [1, -keep], u, zi=[keep * u[0]])
    record = Record(0.01 * np.arange(80), u[:, None], np.zeros((80, 1)))
    np.testing.assert_allclose(lag_inputs(record, 0.03).u[:, 0], expected, rtol=0, atol=1e-12)


def test_a_steady_input_passes_a_lag_unchanged():
    steady = GOOD._replace(u=np.full((4, 1), 2.5))
    np.testing.assert_allclose(lag_inputs(steady, 0.1).u, 2.5, rtol=1e-15)


def test_without_lag_or_delay_the_record_is_the_one_given():
    assert lag_inputs(GOOD, 0.0) is acting_inputs(GOOD) is GOOD


def test_an_input_acts_by_its_mean_over_each_step():
    """Quadrature of the delayed, held or interpolated input over each step, on irregular stamps."""
    random = np.random.default_rng(5)
    t, u = np.cumsum(random.uniform(0.5, 2.0, 12)), random.normal(size=(12, 2))
    record = Record(t, u, np.zeros((12, 1)))
    for between, delay in (("held", 0.7), ("linear", 0.0), ("linear", 1.3)):
        found = acting_inputs(record, between, delay).u
        for k in range(11):
            s = t[k] + (t[k + 1] - t[k]) * (np.arange(20_000) + 0.5) / 20_000 - delay
            held = u[np.maximum(np.searchsorted(t, s, side="right") - 1, 0)]
            signal = np.stack([np.interp(s, t, column) for column in u.T], axis=1) if between == "linear" else held
            np.testing.assert_allclose(found[k], signal.mean(axis=0), rtol=0, atol=2e-4)


@pytest.mark.parametrize(("arguments", "words"), [(("spline", 0.0), "'held' or 'linear'"), (("held", -1.0), "≥ 0")])
def test_an_input_that_acts_in_no_known_way_is_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        acting_inputs(GOOD, *arguments)


def test_coordinates_that_are_late_by_different_times_are_read_together():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.008, 0.012, 300))
    delay = np.array([0.0, 0.025, 0.01])

    def motion(at):
        return np.stack([np.sin(3 * at), np.cos(2 * at), at**2], axis=-1)

    y = np.stack([motion(t - d)[:, i] for i, d in enumerate(delay)], axis=1)
    y[100, 0] = np.nan
    found = read_together(Record(t, t[:, None], y), delay)
    first = int(np.searchsorted(t, t[0] + 0.025))
    np.testing.assert_array_equal(found.t, t[first:])
    np.testing.assert_array_equal(found.u[:, 0], t[first:])
    known = np.isfinite(found.y)
    assert 1 <= (~known).sum() <= 5
    np.testing.assert_allclose(found.y[known], motion(t[first:] - 0.025)[known], rtol=0, atol=2e-6)
    assert np.nanmax(np.abs(y[first:] - motion(t[first:] - 0.025))[known]) > 0.05


def test_a_record_without_inputs_has_none():
    alone = Record(T, y=GOOD.y)
    assert np.shape(alone.u) == (4, 0)
    assert Record(T, None, GOOD.y).check().y is GOOD.y
    axes = Record(0, None, 0)  # of a vmap: no arrays
    assert axes.u is None
    assert jax.tree.map(lambda rows: 2 * rows, alone).check().t[-1] == 0.8


def test_positions_must_be_there_and_real():
    with pytest.raises(ValueError, match="a record needs positions y"):
        Record(T, GOOD.u).check()
    with pytest.raises(ValueError, match=r"positions y .* are complex; they must be real"):
        GOOD._replace(y=GOOD.y * 1j).check()
    unitary = np.broadcast_to(1j * np.eye(2), (4, 2, 2))
    assert GOOD._replace(y=unitary).check().y is unitary


def test_records_and_runs_are_printed_in_one_line():
    assert repr(GOOD) == "<Record: 4 rows over 0.4 s, 2 positions, 1 input>"
    assert repr(GOOD._replace(y=np.zeros((4, 3, 3)))) == "<Record: 4 rows over 0.4 s, positions 3 × 3, 1 input>"
    seen = []
    jax.jit(lambda record: seen.append(repr(record)))(GOOD)
    assert seen == ["<Record: 4 rows, 2 positions, 1 input>"]

    class Info(NamedTuple):
        result: np.ndarray

    run = Run(T, np.zeros((4, 2)), Info(np.array([0, 0, 1, 0])))
    assert repr(run) == "<Run: 4 rows over 0.4 s, 3 ok, 1 coasted>"
    assert repr(Run(T, np.zeros((4, 2)), None)) == "<Run: 4 rows over 0.4 s>"
