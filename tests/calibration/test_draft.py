"""What the columns of a log are taken for, and where it is refused to guess."""

import numpy as np
import pytest

from covariant.calibration import draft

T = np.arange(300) * 2e-3
SWING = np.sin(3 * T)


def columns(**named):
    return {"time": T} | named


def test_names_say_what_columns_are():
    y = np.round(SWING / 1e-3) * 1e-3
    log = columns(joint1_pos=y, joint2_pos=2 * y, joint1_vel=y, joint2_vel=y, joint1_torque=y, temperature=y)
    found = draft(log)
    assert (found.t, found.q) == ("time", ("joint1_pos", "joint2_pos"))
    assert (found.v, found.u, found.left_out) == (("joint1_vel", "joint2_vel"), ("joint1_torque",), ("temperature",))
    assert found.rate == pytest.approx(500)
    assert draft(columns(q=y)).quantum == pytest.approx(1e-3, rel=1e-3)


def test_content_says_it_where_names_do_not():
    rng = np.random.default_rng(0)
    log = {"a": T, "q1": SWING + 1e-3 * rng.normal(size=T.size), "b": 3 * np.cos(3 * T), "c": rng.normal(size=T.size)}
    found = draft(log)
    assert (found.t, found.v, found.left_out) == ("a", ("b",), ("c",))
    assert found.quantum is None
    assert found.noise == pytest.approx(1e-3, rel=0.2)


@pytest.mark.parametrize(
    ("log", "given", "message"),
    [
        (columns(a=SWING), {}, "no column is named like a position.*the columns of numbers are time, a"),
        (columns(q1=SWING, q2=SWING, th1=SWING, th2=SWING), {}, "q1, q2, th1, th2 may all be q; name those"),
        (columns(q=SWING, tau1=SWING, tau2=SWING), {}, '2 inputs .* for 1 positions; name them by `columns\\["u"\\]`'),
        ({"q": SWING}, {}, "no column of stamps rises"),
        (
            {"a": T, "b": T, "q": SWING},
            {},
            'a, b all rise from row to row; name the one of the stamps by `columns\\["t"\\]`',
        ),
        (columns(q=SWING), {"q": ["angle"]}, "no column 'angle' of numbers; the columns of numbers are time, q"),
        (columns(q=np.where(T == 0, np.nan, SWING)), {}, "row 1 lacks a position"),
    ],
)
def test_what_is_ambiguous_is_refused_with_the_columns_that_were_seen(log, given, message):
    with pytest.raises(ValueError, match=message):
        draft(log, given)


def test_names_that_are_given_are_not_guessed():
    found = draft(columns(q1=SWING, q2=SWING, th1=SWING, th2=SWING), {"q": ["th1", "th2"]})
    assert found.q == ("th1", "th2")
    assert found.left_out == ("q1", "q2")


UNITS = [
    ({"t": 1e3 * T, "q": SWING}, {"t": ("ms",)}, ("t",)),
    ({"t": T, "q": 60 * SWING}, {"q": ("deg",)}, ("q",)),
    ({"time [ms]": 1e3 * T, "q1_deg": SWING, "q2_deg": SWING}, {"t": ("ms",), "q": ("deg", "deg")}, ()),
    ({"time_s": T, "theta [rad]": SWING, "torque [mN m]": SWING}, {"u": ("mN m",)}, ()),
    ({"t": T, "th1 (turn/4096)": SWING, "th2 (rad)": SWING}, {"q": ("turn/4096", "rad")}, ()),
    ({"t": T, "q": SWING, "q1 [deg/s]": SWING}, {"v": ("deg/s",)}, ()),
    ({"t": T, "q (1)": SWING, "q (2)": SWING}, {}, ()),
    ({"t": 2.0 * np.arange(300), "q [m]": SWING}, {"t": ("ms",)}, ("t",)),
]


@pytest.mark.parametrize(("log", "units", "guessed"), UNITS)
def test_header_and_numbers_say_the_units(log, units, guessed):
    found = draft(log)
    assert (found.units, found.guessed) == (units, guessed)
    if units.get("t") == ("ms",):
        assert found.rate == pytest.approx(500)


def test_the_tick_is_in_the_unit_of_the_file():
    y = np.round(SWING * 300) / 300 * 360
    assert draft({"t": T, "q [deg]": y}).quantum == pytest.approx(2 * np.pi / 300, rel=1e-3)
