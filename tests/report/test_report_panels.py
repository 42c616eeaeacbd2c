"""What is drawn, and how much of it is shown."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from covariant.report._axis_range import axis_range
from covariant.report._panels import Curve, Quantity, depths, quantities
from covariant.report._polylines import LIMIT, polyline, thin
from covariant.report._style import styles

T = np.linspace(0.0, 10.0, 4001)
NOISE = np.random.default_rng(1).standard_normal(len(T))


def panel(*curves, scale=1.0, **options) -> Quantity:
    """One panel of the named curves, which start with a backdrop where the name says so."""
    made = tuple(Curve(T, y[:, None], label, backdrop=label == "truth") for label, y in curves)
    return Quantity("panel", "Panel", ("y",), made, np.array([scale]), **options)


@given(st.integers(1, 40_000), st.integers(30, 6000), st.integers(0, 99))
def test_thinning_keeps_extremes_and_gaps(samples, limit, seed):
    rng = np.random.default_rng(seed)
    t, y = np.arange(samples, dtype=float), rng.standard_normal(samples)
    y[rng.integers(0, samples)] = 50.0
    y[rng.integers(0, samples)] = -50.0
    gaps = rng.uniform(size=samples) < 1e-3
    y[gaps] = np.nan
    thin_t, thin_y = thin(t, y, limit)
    assert len(thin_t) == len(thin_y) <= max(limit, 3)
    assert (np.diff(thin_t) > 0).all()
    assert np.isnan(thin_y).any() == gaps.any()
    if not gaps.all():
        assert np.nanmax(thin_y) == np.nanmax(y)
        assert np.nanmin(thin_y) == np.nanmin(y)


def test_short_curves_are_not_thinned():
    assert thin(T, NOISE)[1] is NOISE
    assert len(thin(np.arange(1e6), np.zeros(10**6))[0]) <= LIMIT


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
    assert depths(panel(("truth", NOISE), large, small), 0) == [0, 2, 1]


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
    assert plain["velocity"].labels == ("dx/dt [1/s]", "slider position\n[m/s]")


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
    estimates, whole = panels["velocity"].curves[1:], quantities(make())["velocity"].curves[1:]
    for found, same in zip(estimates, whole, strict=True):
        np.testing.assert_array_equal(found.values, same.values)


def test_names_on_a_group_are_all_written_alike(make):
    labels = quantities(on_a_group(make(), ("roll_rate", "sway", "x")))["innovation"].labels
    assert labels == ("roll_rate\n[rad]", "sway\n[m]", "x")
