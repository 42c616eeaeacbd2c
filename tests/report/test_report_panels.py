"""What is drawn, and how much of it is shown."""

import numpy as np
import pytest

from covariant.report import PALETTE
from covariant.report._axis_range import AxisRange, axis_range
from covariant.report._condensed import NUMBERS, condensed
from covariant.report._panels import Curve, Quantity, depths, quantities
from covariant.report._plotly import _log_ticks
from covariant.report._polylines import polygons, polyline
from covariant.report._style import styles
from covariant.report._whiteness import autocorrelation

T = np.linspace(0.0, 10.0, 4001)
NOISE = np.random.default_rng(1).standard_normal(len(T))


def panel(*curves, scale=1.0, **options) -> Quantity:
    """One panel of the named curves, which start with a backdrop where the name says so."""
    roles = {"truth": "reference", "readings": "measured"}
    made = tuple(Curve(T, y[:, None], label, roles.get(label, "estimate")) for label, y in curves)
    return Quantity("panel", "Panel", ("y",), made, np.array([scale]), **options)


def test_a_thinned_ramp_rises():
    """The two samples of an interval stand in the order in which they occur."""
    t = np.arange(3.0 * NUMBERS)
    ramp = Quantity("panel", "Panel", ("y",), (Curve(t, t[:, None], "one"),), np.ones(1))
    assert (np.diff(condensed({"panel": ramp})["panel"].curves[0].values[:, 0]) > 0).all()


def test_innovations_of_white_noise_are_within_the_bounds_and_those_of_a_sum_are_not():
    noise = np.random.default_rng(0).standard_normal((4000, 1))
    noise[100:130] = np.nan
    white = autocorrelation(np.arange(4000) / 500, noise)
    assert np.mean(np.abs(white.values) < white.bound) > 0.85
    assert white.lags[0] == pytest.approx(2e-3)
    moving = autocorrelation(np.arange(4000) / 500, noise + np.roll(noise, 1))
    assert moving.values[0, 0] == pytest.approx(0.5, abs=0.05)
    assert autocorrelation(np.arange(4000.0), np.zeros((4000, 1))) is None


def test_running_rms_is_that_of_the_samples_around():
    """White noise whose level doubles half way: the RMS is its level away from the change and from the ends."""
    t, level = np.arange(60_000) / 1e3, np.repeat([1.0, 2.0], 30_000)
    y = level * np.random.default_rng(0).standard_normal(len(t))
    two = tuple(Curve(t, y[:, None], label) for label in ("one", "two"))
    found = condensed({"panel": Quantity("panel", "Panel", ("y",), two, np.ones(1), deviation=True)})["panel"]
    assert found.log  # of several estimates only the RMS is drawn
    assert found.title == "Panel, RMS over 1 s"
    for curve in found.curves:
        expected = np.where(curve.t < 30, 1.0, 2.0)
        apart = np.abs(curve.t - 30) > 1
        np.testing.assert_allclose(curve.values[apart, 0], expected[apart], rtol=0.12)


def test_short_curves_are_drawn_as_they_are(make):
    found = quantities(make(2))
    assert condensed(found) is found


def test_bands_are_closed_polygons_with_gaps():
    t, low = np.arange(5.0), np.array([0.0, 1.0, np.nan, 3.0, 4.0])
    x, y = polygons(t, low, low + 0.5)
    np.testing.assert_array_equal(x, [0, 1, 1, 0, 1, 3, 4, 4, 3, 4])
    np.testing.assert_array_equal(y, [0, 1, 1.5, 0.5, np.nan, 3, 4, 4.5, 3.5, np.nan])
    assert len(polygons(t, low * np.nan, low)[0]) == 0


def test_samples_without_neighbours_become_dots():
    y = np.full(len(T), np.nan)
    y[::10] = 1.0
    y[100:105] = 2.0
    line, dots = polyline(T, y, log=False)
    assert np.nansum(line[1]) == 10.0
    assert set(dots[1]) == {1.0}
    assert len(dots[1]) == np.isfinite(y).sum() - 5


def test_log_axis_leaves_gaps_where_it_has_no_place():
    line, dots = polyline(T[:6], np.array([1.0, 2.0, 0.0, -1.0, np.inf, 3.0]), log=True)
    np.testing.assert_array_equal(line[1], [1.0, 2.0, np.nan, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(dots[1], [3.0])


def test_overshoot_is_cut_and_steady_part_is_not():
    y = 0.1 * NOISE + 30 * np.exp(-5 * T)
    seen = axis_range(panel(("EKF", y)), 0)
    steady = y[T > 2.5]
    assert seen.low <= steady.min() < steady.max() <= seen.high < 1.0
    assert seen.outside.startswith("off scale: EKF 30")


def test_small_overshoot_is_not_cut():
    y = 0.1 * NOISE + 0.3 * np.exp(-5 * T)
    seen = axis_range(panel(("EKF", y)), 0)
    assert seen.low < y.min() < y.max() < seen.high
    assert seen.outside == ""


def test_exact_simulation_shows_its_transient():
    y = 3 * np.exp(-9 * T)
    assert axis_range(panel(("EKF", y)), 0).high > 3


def test_backdrop_is_whole_and_lost_estimate_does_not_hide_it():
    truth = np.sin(T) + 5 * (T < 0.1)
    seen = axis_range(panel(("truth", truth), ("good", truth + 0.01 * NOISE), ("lost", np.exp(3 * T)), scale=2.0), 0)
    assert truth.max() <= seen.high < 10
    assert "lost 1.07e+13" in seen.outside


def test_single_spikes_do_not_set_the_axis():
    y = 0.1 * NOISE
    y[3000] = -40.0
    seen = axis_range(panel(("EKF", y)), 0)
    assert seen.low > -2
    assert seen.outside == "off scale: EKF −40"


@pytest.mark.parametrize("level", [0.0, -2.0, 1e-20, 1e20])
def test_constant_has_room(level):
    seen = axis_range(panel(("EKF", np.full(len(T), level))), 0)
    assert seen.low < level < seen.high


def test_log_view():
    decay = np.exp(-2 * T)
    decay[7] = 0.0
    seen = axis_range(panel(("EKF", decay), deviation=True, log=True), 0)
    assert 0 < seen.low < decay[-1] < 1 < seen.high
    equal = axis_range(panel(("EKF", np.full(len(T), 0.3)), log=True), 0)
    assert equal.high / equal.low == pytest.approx(10)
    assert axis_range(panel(("EKF", np.zeros(len(T))), log=True), 0) is None


def test_smallest_deviation_lies_in_front():
    large, small = ("large", 2 * NOISE), ("small", NOISE)
    assert depths(panel(large, small, deviation=True), 0) == [0, 1]
    assert depths(panel(small, large, deviation=True), 0) == [1, 0]


def test_a_reference_is_in_front_of_the_estimates_and_the_readings_are_behind():
    curves = ("readings", NOISE), ("truth", NOISE), ("first", NOISE), ("second", 2 * NOISE)
    assert depths(panel(*curves), 0) == [0, 3, 2, 1]
    assert depths(panel(*reversed(curves)), 0) == [2, 1, 3, 0]


def test_readings_reference_and_estimate_differ_in_width_dash_and_colour(make):
    report = make(1)
    found = styles(report)
    readings, reference, first = (
        found[label] for label in ("measured", report.v_reference_label, next(iter(report.estimates)))
    )
    assert readings.width > 1.5 * first.width > 1.5 * reference.width
    assert reference.dash
    assert not first.dash
    assert len({readings.color, reference.color, first.color}) == len({readings.dark, first.dark, reference.dark}) == 3


def linear_rgb(color):
    rgb = np.frombuffer(bytes.fromhex(color[1:]), np.uint8) / 255
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def test_every_colour_is_seen_on_its_page(make):
    """Contrast of 3 with a dark page, as WCAG asks of graphics; on white, of 2, that of the lightest in the palette."""

    def contrast(one, other):
        dim, bright = sorted([0.2126, 0.7152, 0.0722] @ linear_rgb(color) for color in (one, other))
        return (bright + 0.05) / (dim + 0.05)

    many = make(1, labels=tuple(f"estimator {i}" for i in range(len(PALETTE))))
    for style in styles(many).values():
        assert contrast(style.dark, "#16191d") > 3
        assert contrast(style.color, "#ffffff") > 2
    assert len({style.dark for style in styles(many).values()}) == len(PALETTE) + 2  # readings and their slopes alike


SEEN = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
)
"""Linear RGB as seen with all cones, and without the red, the green or the blue ones (Machado et al. 2009)."""
XYZ = ((0.4339, 0.3762, 0.1899), (0.2127, 0.7152, 0.0722), (0.0178, 0.1095, 0.8727))
"""Linear RGB to CIE XYZ, relative to white."""


@pytest.mark.parametrize("seen", SEEN, ids=["all cones", "no red", "no green", "no blue"])
def test_colours_of_a_dark_page_are_as_distinct_as_on_white(seen, make):
    def distance(colors):
        linear = np.array([linear_rgb(color) for color in colors])
        x, y, z = np.cbrt(np.array(XYZ) @ np.clip(np.array(seen) @ linear.T, 0, 1))
        lab = np.stack([116 * y, 500 * (x - y), 200 * (y - z)], axis=1)
        return min(np.linalg.norm(lab[i] - lab[j]) for i in range(len(lab)) for j in range(i))

    many = styles(make(1, labels=tuple(f"estimator {i}" for i in range(len(PALETTE)))))
    found = [style for label, style in many.items() if label != "measured"]  # its slopes have the same colour
    assert distance([style.dark for style in found]) > 0.97 * distance([style.color for style in found]) > 7


@pytest.mark.parametrize("high", [1.02, 3.0, 30.0, 1e9])
def test_logarithmic_axes_have_a_few_plain_ticks(high):
    ticks = _log_ticks(AxisRange(3e-4, 3e-4 * high, ""))
    if high < 5:
        step = float(ticks["dtick"].removeprefix("L"))
        assert 2.99 < 3e-4 * (high - 1) / step < 10
        assert ticks["tickformat"] == "~g"
        return
    shown = [tick for tick in ticks["tickvals"] if 3e-4 <= tick <= 3e-4 * high]
    assert 3 <= len(shown) <= 9
    assert [float(text) for text in ticks["ticktext"]] == pytest.approx(ticks["tickvals"])


def test_quantities(make):
    report = make(2)
    found = quantities(report)
    assert list(found) == ["position", "velocity", "error", "innovation", "distance"]
    assert found["velocity"].labels == ("dθ/dt [rad/s]", "dφ/dt [rad/s]")
    x = next(iter(report.estimates.values()))
    np.testing.assert_array_equal(found["error"].curves[0].values, x[:, 2:] - report.v_reference)
    assert [curve.label for curve in found["distance"].curves] == list(report.distance)
    assert "error" not in quantities(report._replace(v_reference=None))
    plain = quantities(report._replace(units=("", "m"), coordinates=("x", "slider position")))
    assert plain["position"].labels == ("x", "slider position\n[m]")
    assert plain["velocity"].labels == ("x\n[1/s]", "slider position\n[m/s]")


def on_a_group(report, names):
    """The same report of velocities alone, in rad/s and m/s, of a configuration that is no curve."""
    velocities = {label: x[:, 3:] for label, x in report.estimates.items()}
    return report._replace(
        coordinates=names, units=("rad/s", "m/s", ""), q_measured=None, estimates=velocities, title="group"
    )


def test_on_a_group_velocities_stand_for_themselves_and_there_is_no_position(make):
    report = on_a_group(make(), ("w1", "v", "x"))
    panels = quantities(report.check())
    assert list(panels) == ["velocity", "error", "innovation", "distance"]
    assert panels["velocity"].labels == ("w1 [rad/s]", "v [m/s]", "x")
    assert panels["error"].labels == ("error of w1 [rad/s]", "error of v [m/s]", "error of x")
    assert panels["innovation"].labels == ("along w1 [rad]", "along v [m]", "along x")
    assert list(styles(report)) == [report.v_reference_label, *report.estimates]
    # On a group nothing is measured whose slopes could be drawn.
    estimates, whole = panels["velocity"].curves[1:], quantities(make())["velocity"].curves[2:]
    for found, same in zip(estimates, whole, strict=True):
        np.testing.assert_array_equal(found.values, same.values)


def test_names_on_a_group_are_all_written_alike(make):
    labels = quantities(on_a_group(make(), ("roll_rate", "sway", "x")))["innovation"].labels
    assert labels == ("roll_rate\n[rad]", "sway\n[m]", "x")
