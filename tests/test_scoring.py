"""The reference that velocities are scored against, computed a second time in the plainest way, and its window."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from covariant import scoring
from covariant.scoring import rmse, scored_window, unwrap, zero_phase_twist, zero_phase_velocity


@pytest.fixture
def log():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.001, 0.005, 300))
    y = np.stack([np.sin(7 * t), np.cos(3 * t) + t], axis=1) + rng.normal(0, 1e-3, (300, 2))
    return t, y


def plain_slope(t, y, now, half, order):
    """Slope at `now` of the weighted least-squares polynomial over the measurements within `half` of it."""
    near = np.abs(t - now) <= half
    weight = np.sqrt((1 - (np.abs(t[near] - now) / half) ** 3) ** 3)
    fit = np.polyfit((t[near] - now) / half, y[near], order, w=weight)
    return fit[-2] / half


@pytest.mark.parametrize(("half", "order"), [(0.03, 3), (0.05, 4), (0.04, 1)])
def test_the_reference_is_a_local_polynomial_with_tricube_weights(log, half, order):
    t, y = log
    at = t[(t > t[0] + half) & (t < t[-1] - half)][::5]
    expected = [[plain_slope(t, y[:, i], now, half, order) for i in range(2)] for now in at]
    # 1e-6 of weight is kept at the rim, so that no fit is singular.
    np.testing.assert_allclose(zero_phase_velocity(t, y, at, half, order), expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize("end", [0, -1])
def test_where_measurements_are_few_the_nearest_ones_are_used(log, end):
    """Fewer than order + 3 within `half`: order + 3 to either side, as far as there are any, over their own reach."""
    t, y = log
    rows = slice(0, 6) if end == 0 else slice(-6, None)
    s = t[rows] - t[end]
    reach = np.abs(s).max()
    weight = (1 - (np.abs(s) / reach) ** 3) ** 1.5 + 1e-6
    expected = [np.polyfit(s / reach, column, 2, w=weight)[1] / reach for column in y[rows].T]
    found = zero_phase_velocity(t, y, t[[end]], half=1e-5, order=2)
    np.testing.assert_allclose(found, [expected], rtol=1e-6)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("more", [2, 3], ids=["too few", "just enough"])
def test_a_window_needs_two_measurements_more_than_the_polynomial_has_coefficients(order, more):
    """The one at each rim may weigh nothing, and the rest must still determine the polynomial: order + 1 + 2 of them.

    With order + 3 the window is as it is; with one less it grows by order + 3 to either side, over its own reach.
    """
    t, count = 0.01 * np.arange(60), order + more
    y = np.random.default_rng(order).normal(size=60)
    first = 25
    middle, half = (t[first] + t[first + count - 1]) / 2, 0.01 * (count - 1) / 2 + 0.002
    wider = 0 if more == 3 else order + 3
    rows = slice(first - wider, first + count + wider)
    s = t[rows] - middle
    reach = max(half, np.abs(s).max())
    weight = (1 - np.minimum(np.abs(s) / reach, 1) ** 3) ** 1.5 + 1e-6
    expected = np.polyfit(s / reach, y[rows], order, w=weight)[-2] / reach
    found = zero_phase_velocity(t, y[:, None], np.array([middle]), half, order)
    np.testing.assert_allclose(found, [[expected]], rtol=1e-8)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_polynomials_are_exact_everywhere(log, order):
    t, _ = log
    shape = np.polynomial.Polynomial(np.random.default_rng(order).normal(size=order + 1))
    y = np.stack([shape(t), -2 * shape(t)], axis=1)
    at = np.concatenate([t, np.linspace(t[0], t[-1], 17)])
    found = zero_phase_velocity(t, y, at, 0.03, order)
    expected = shape.deriv()(at)
    np.testing.assert_allclose(found, np.stack([expected, -2 * expected], axis=1), rtol=0, atol=1e-7)


def test_missing_positions_are_left_out_column_by_column(log):
    t, y = log
    holes = y.copy()
    holes[50:60, 0] = holes[::7, 1] = np.nan
    found = zero_phase_velocity(t, holes, t)
    for column, present in enumerate(np.isfinite(holes).T):
        alone = zero_phase_velocity(t[present], y[present][:, [column]], t)
        np.testing.assert_array_equal(found[:, [column]], alone)
    assert np.abs(found - zero_phase_velocity(t, y, t)).max() < 0.5


def test_too_short_a_log_says_how_many_measurements_it_needs():
    t = np.arange(5.0)
    with pytest.raises(ValueError, match="order 3 needs 6 measurements; there are 5"):
        zero_phase_velocity(t, np.zeros((5, 1)), t)
    y = np.zeros((8, 1))
    y[3:6] = np.nan
    with pytest.raises(ValueError, match="order 3 needs 6 measurements; there are 5"):
        zero_phase_velocity(np.arange(8.0), y, t)
    assert zero_phase_velocity(np.arange(6.0), np.arange(6.0)[:, None], t).shape == (5, 1)


def test_the_first_second_and_the_end_are_not_scored():
    t = 5 + 0.01 * np.arange(301)
    mask = scored_window(t)
    np.testing.assert_array_equal(mask, (t > 6) & (t < 7.8))
    np.testing.assert_array_equal(scored_window(t, skip=2.0, tail=0.0), (t > 7) & (t < 8))


def test_of_a_short_log_the_second_half_is_scored():
    t = 5 + 0.01 * np.arange(100)
    np.testing.assert_array_equal(scored_window(t), t >= (t[0] + t[-1]) / 2)
    assert scored_window(np.array([0.0, 1.0])).any()


def test_rmse_is_taken_coordinate_by_coordinate():
    np.testing.assert_allclose(rmse(np.array([[1.0, 2.0], [3.0, 2.0]]), np.zeros((2, 2))), [5**0.5, 2.0])
    np.testing.assert_array_equal(np.isnan(rmse(np.array([[np.nan, 1.0]]), np.zeros((1, 2)))), [True, False])


def test_turns_are_undone_on_circles_only_and_across_gaps():
    t = np.linspace(0, 4, 80)
    turning = np.stack([3 * t, 3 * t], axis=1)
    y = (turning + np.pi) % (2 * np.pi) - np.pi
    y[20:23, 0] = np.nan
    before = y.copy()
    plain = unwrap(y, (0,))
    present = np.isfinite(y[:, 0])
    np.testing.assert_allclose(plain[present, 0], turning[present, 0], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(plain[:, 1], y[:, 1])
    np.testing.assert_array_equal(np.isnan(plain), np.isnan(y))
    np.testing.assert_array_equal(y, before)


def precession(t):
    """Attitudes `exp(a(t) x) exp(40 t n)` and their angular velocities in the body: `a' x` as seen there, plus 40 n."""
    axis = np.array([0.0, 0.6, 0.8])
    spin = Rotation.from_rotvec(np.outer(40 * t, axis)).as_matrix()
    tilt = Rotation.from_rotvec(np.outer(np.sin(2 * t), [1, 0, 0])).as_matrix()
    return tilt @ spin, np.einsum("kji,kj->ki", spin, np.outer(2 * np.cos(2 * t), [1, 0, 0])) + 40 * axis


@pytest.fixture
def stamps():
    return np.cumsum(np.random.default_rng(0).uniform(0.0005, 0.0015, 1500))


def test_the_reference_of_an_attitude_is_its_angular_velocity(stamps):
    attitude, velocity = precession(stamps)
    found = zero_phase_twist(stamps, attitude, stamps)
    np.testing.assert_allclose(found[40:-40], velocity[40:-40], atol=1e-3)
    finer = zero_phase_twist(stamps, attitude, stamps, half=0.01, order=4)
    np.testing.assert_allclose(finer[20:-20], velocity[20:-20], atol=1e-5)


def test_missing_attitudes_are_left_out(stamps):
    attitude, velocity = precession(stamps)
    attitude[700:712] = np.nan
    attitude[300::3, 0, 0] = np.nan
    found = zero_phase_twist(stamps, attitude, stamps[::7])
    np.testing.assert_allclose(found[10:-10], velocity[::7][10:-10], atol=5e-3)


def test_noise_is_smoothed_as_in_coordinates(stamps):
    attitude, velocity = precession(stamps)
    rng = np.random.default_rng(1)
    noisy = attitude @ Rotation.from_rotvec(rng.normal(0, 1e-3, (len(stamps), 3))).as_matrix()
    flat = zero_phase_velocity(stamps, rng.normal(0, 1e-3, (len(stamps), 3)), stamps)
    error = zero_phase_twist(stamps, noisy, stamps) - velocity
    assert np.std(error[40:-40]) == pytest.approx(np.std(flat[40:-40]), rel=0.1)


def test_the_window_shrinks_for_a_body_that_spins_fast(stamps):
    spinning = Rotation.from_rotvec(np.outer(150 * stamps, [0, 0.6, 0.8])).as_matrix()
    np.testing.assert_allclose(
        zero_phase_twist(stamps, spinning, stamps), np.tile([0, 90, 120], (1500, 1)), rtol=1e-9, atol=1e-7
    )


def test_the_reference_of_a_pose_is_its_twist_in_the_body(stamps):
    attitude, velocity = precession(stamps)
    g = np.tile(np.eye(4), (1500, 1, 1))
    g[:, :3, :3] = attitude
    g[:, :3, 3] = np.stack([np.sin(3 * stamps), stamps**2, 2 * stamps], axis=1)
    speed = np.stack([3 * np.cos(3 * stamps), 2 * stamps, np.full(1500, 2.0)], axis=1)
    found = zero_phase_twist(stamps, g, stamps)
    np.testing.assert_allclose(found[40:-40, 3:], velocity[40:-40], atol=1e-3)
    np.testing.assert_allclose(found[40:-40, :3], np.einsum("kji,kj->ki", attitude, speed)[40:-40], atol=1e-4)


def test_the_reference_in_the_plane(stamps):
    angle = 5 * np.sin(9 * stamps) + 30 * stamps
    g = np.tile(np.eye(3), (1500, 1, 1))
    g[:, :2, :2] = np.moveaxis(np.array(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle)))), 2, 0)
    g[:, 0, 2] = 4 * stamps
    rate = 45 * np.cos(9 * stamps) + 30
    found = zero_phase_twist(stamps, g, stamps, space=2)
    expected = np.stack([4 * np.cos(angle), -4 * np.sin(angle), rate], axis=1)
    np.testing.assert_allclose(found[40:-40], expected[40:-40], atol=0.01)
    np.testing.assert_array_equal(zero_phase_twist(stamps, g[:, :2, :2], stamps, space=2), found[:, 2:])


def test_windows_of_an_even_log_are_fitted_once_for_all_columns(monkeypatch):
    """A long log is scored by a few fits, not by one for each row and column; jittered stamps need one for each row."""
    fitted = []
    weights = scoring._weights
    monkeypatch.setattr(scoring, "_weights", lambda *given: fitted.append(len(given[1])) or weights(*given))
    t = np.arange(20_000) / 1e3
    y = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    slopes = scoring.zero_phase_velocity(t, y, t)
    assert sum(fitted) < 100 + len(t) / 500
    np.testing.assert_allclose(slopes, np.stack([3 * np.cos(3 * t), -2 * np.sin(2 * t)], axis=1), atol=2e-3)
    fitted.clear()
    jittered = t[:500] + 1e-5 * np.sin(np.arange(500) ** 2)
    scoring.zero_phase_velocity(jittered, y[:500], jittered)
    assert sum(fitted) == 500


def test_the_velocity_of_what_stands_still_is_zero_and_no_rounding_error():
    t = np.sort(np.random.default_rng(0).uniform(0, 1, 60))
    y = np.column_stack([np.full(60, 1e6 / 3), t, np.where(t > 0.5, np.nan, 0.1)])
    v = scoring.zero_phase_velocity(t, y, t)
    assert not v[:, [0, 2]].any()
    np.testing.assert_allclose(v[:, 1], 1.0)
    np.testing.assert_allclose(scoring.local_polynomials(t, y, t)[:, 0, 0], 1e6 / 3)
    still = np.broadcast_to(np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]), (60, 3, 3))
    assert not scoring.zero_phase_twist(t, still, t).any()
