"""The line-up of estimators: the errors that the design predicts against simulation, and the choices it makes."""

import math

import equinox as eqx
import numpy as np
import pytest
from scipy import linalg

from covariant import geometry
from covariant.calibration import (
    ESTIMATORS,
    DataSheet,
    Trial,
    estimators,
    gains,
    observer_gains,
    tuned_estimators,
)
from covariant.calibration.tuning._filters import (
    LONGEST_WINDOW,
    filter_bandwidth,
    filter_error,
    filtered,
    jerk_bound,
    joint_noise,
    linear_filter_error,
    polynomial,
)
from covariant.models import Lagrangian, heavy_top, oscillator, underwater_vehicle
from covariant.observers import (
    EKF,
    PLL,
    FilteredDerivative,
    Gated,
    Geodesic,
    HighGain,
    Intrinsic,
    IntrinsicForce,
    IntrinsicKalman,
    JointKalman,
    LagrangianMetric,
    MeasuredCoefficients,
    ModelCopy,
    SavitzkyGolay,
    run,
)
from covariant.signals import Record

AXES = 8
FLAT = Lagrangian(geometry.Euclidean(), lambda q: 0.0 * q[0])
"""A free point in eight dimensions: as many double integrators, watched by one observer."""


SHEET = DataSheet(1e-3, 2.0, 0.01, motion_std=20.0, motion_time=0.05)
RATE = 200.0
WEIGHTS = {
    "difference": np.array([RATE, -RATE]),
    "filtered derivative": FilteredDerivative(30.0).weights(RATE),
    "line": SavitzkyGolay(9, 1).weights(RATE),
    "parabola": SavitzkyGolay(15, 2).weights(RATE),
}


def test_weights_form_a_slope():
    ages = {name: np.arange(len(w)) / RATE for name, w in WEIGHTS.items()}
    for name, w in WEIGHTS.items():
        assert w.sum() == pytest.approx(0, abs=1e-4 * np.abs(w).sum())
        assert -w @ ages[name] == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize("motion_time", [0.02, 0.3])
def test_the_predicted_error_of_a_filter_is_that_of_the_motion_it_assumes(name, motion_time):
    """Accelerations of exponential correlation, weighed by the filter, by the trapezoid rule; and noise."""
    sheet, w = SHEET._replace(motion_time=motion_time), WEIGHTS[name]
    ages = np.arange(len(w)) / RATE
    h = np.maximum(ages[None, :] - ages[:, None], 0) @ w / RATE  # the weight of the acceleration of an age
    h[0] /= 2
    correlation = linalg.toeplitz(np.exp(-ages / motion_time))
    expected = math.hypot(sheet.measurement_std * np.linalg.norm(w), sheet.motion_std * math.sqrt(h @ correlation @ h))
    assert linear_filter_error(w, sheet, RATE) == pytest.approx(expected, rel=1e-10)


def test_a_difference_is_half_a_sample_late_and_a_parabola_is_not():
    steady = SHEET._replace(measurement_std=0.0, motion_time=1e12)
    assert linear_filter_error(WEIGHTS["difference"], steady, RATE) == pytest.approx(20.0 / (2 * RATE), rel=1e-6)
    assert linear_filter_error(WEIGHTS["parabola"], steady, RATE) == pytest.approx(0.0, abs=1e-6)
    late = linear_filter_error(WEIGHTS["filtered derivative"], steady, RATE)
    assert late == pytest.approx(20.0 / (RATE * -np.expm1(-30.0 / RATE)) - 20.0 / (2 * RATE), rel=1e-3)


@pytest.mark.parametrize("noise", [3e-4, 1e-3, 1e-2])
def test_bandwidth_and_window_are_the_best_ones(noise):
    sheet = SHEET._replace(measurement_std=noise)
    chosen = filter_bandwidth(sheet, RATE)
    least = linear_filter_error(FilteredDerivative(chosen).weights(RATE), sheet, RATE)
    for factor in (0.5, 0.8, 1.25, 2.0):
        assert linear_filter_error(FilteredDerivative(chosen * factor).weights(RATE), sheet, RATE) > least
    window, order = polynomial(sheet, RATE)
    least = linear_filter_error(SavitzkyGolay(window, order).weights(RATE), sheet, RATE)
    for other in (window - 1, window + 1, 2 * window):
        assert other <= order or linear_filter_error(SavitzkyGolay(other, order).weights(RATE), sheet, RATE) >= least
    assert 3 <= window <= LONGEST_WINDOW


def test_more_noise_wants_more_smoothing():
    sheets = [SHEET._replace(measurement_std=s) for s in (1e-4, 1e-3, 1e-2)]
    assert np.all(np.diff([filter_bandwidth(s, RATE) for s in sheets]) < 0)
    assert np.all(np.diff([polynomial(s, RATE)[0] for s in sheets]) > 0)
    assert np.all(np.diff([observer_gains(s, RATE).alpha for s in sheets]) < 0)


def ungated(made):
    """The observers themselves; each that has no gate of its own stands behind one for the sheet's noise and speed."""
    for observer in made.values():
        if isinstance(observer, Gated):
            assert (observer.noise, observer.speed) == (SHEET.measurement_std, SHEET.motion_std * SHEET.motion_time)
    return {name: each.observer if isinstance(each, Gated) else each for name, each in made.items()}


def test_all_estimators_come_from_one_data_sheet():
    model = oscillator()
    estimators = ungated(tuned_estimators(model, 1, SHEET, RATE))
    chosen = observer_gains(SHEET, RATE)
    assert chosen == gains(1e-3, RATE, 2.0, 0.01, SHEET.damping)
    for name, kind in {
        "intrinsic": Intrinsic,
        "intrinsic2": Intrinsic,
        "intrinsic-force": IntrinsicForce,  # which learns no force without one on the sheet
        "geodesic": Geodesic,
        "lagrangian-metric": LagrangianMetric,
        "measured-coefficients": MeasuredCoefficients,
        "copy": ModelCopy,
    }.items():
        assert isinstance(estimators[name], kind)
        assert (estimators[name].alpha, estimators[name].beta) == (chosen.alpha, chosen.beta)
    assert [estimators[name].order for name in ("intrinsic", "intrinsic2")] == [1, 2]
    ekf = estimators["ekf"]
    assert isinstance(ekf, EKF)
    assert float(ekf.process_cov[0, 0]) == pytest.approx(2 * 2.0**2 * 0.01)
    assert float(ekf.measurement_cov[0, 0]) == pytest.approx(1e-6)
    assert ekf.initial_velocity_std == pytest.approx(1.0)
    kalman = estimators["intrinsic-kalman"]
    assert isinstance(kalman, IntrinsicKalman)
    np.testing.assert_array_equal(kalman.process_cov, ekf.process_cov)
    np.testing.assert_allclose(kalman.initial_velocity_cov, np.eye(1), rtol=1e-12)
    assert eqx.tree_equal(estimators["filtered-derivative"], FilteredDerivative(filter_bandwidth(SHEET, RATE)))
    assert eqx.tree_equal(estimators["savitzky-golay"], SavitzkyGolay(*polynomial(SHEET, RATE)))
    assert len(estimators) == 17


def test_an_acceleration_new_at_each_sample_is_white_over_one():
    fresh = SHEET._replace(correlation_time=None)
    assert observer_gains(fresh, RATE) == observer_gains(fresh._replace(correlation_time=1 / (2 * RATE)), RATE)
    assert float(tuned_estimators(oscillator(), 1, fresh, RATE)["ekf"].process_cov[0, 0]) == pytest.approx(
        2.0**2 / RATE
    )


@pytest.mark.parametrize("field", ["measurement_std", "acceleration_std", "correlation_time", "damping"])
@pytest.mark.parametrize("number", [0.0, math.nan, math.inf])
def test_a_number_that_makes_no_sense_is_named(field, number):
    with pytest.raises(ValueError, match=f"gains: {field} must be a positive, finite number; got {number}"):
        tuned_estimators(oscillator(), 1, SHEET._replace(**{field: number}), RATE)


@pytest.mark.parametrize("field", ["motion_std", "motion_time"])
@pytest.mark.parametrize("number", [-1.0, math.nan])
def test_a_motion_that_makes_no_sense_is_named(field, number):
    with pytest.raises(ValueError, match=field):
        tuned_estimators(oscillator(), 1, SHEET._replace(**{field: number}), RATE)


def test_a_model_is_offered_the_estimators_that_fit_it():
    top, vehicle = heavy_top((0.1, 0.2, 0.6)), underwater_vehicle()
    assert estimators(FLAT) == tuple(tuned_estimators(FLAT, AXES, SHEET, RATE))
    gains = ("intrinsic", "intrinsic2", "intrinsic-force", "geodesic", "lagrangian-metric", "copy")
    anywhere = (*gains, "intrinsic-kalman", "ekf", "ukf", "tracking-loop")
    assert estimators(top) == (*anywhere, "salcudean") == tuple(tuned_estimators(top, 3, SHEET, RATE))
    assert estimators(vehicle) == anywhere == tuple(tuned_estimators(vehicle, 6, SHEET, RATE))
    assert {*estimators(FLAT), *estimators(top)} == set(ESTIMATORS)


def test_on_groups_all_have_the_same_gains_and_noise():
    top = heavy_top((0.1, 0.2, 0.6))
    chosen, made = observer_gains(SHEET, RATE), ungated(tuned_estimators(top, 3, SHEET, RATE))
    for name in ("intrinsic", "intrinsic2", "geodesic", "lagrangian-metric", "copy"):
        assert (made[name].alpha, made[name].beta) == (chosen.alpha, chosen.beta)
    mean = 0.3  # Salcudean's gains, of the mean principal inertia
    assert made["salcudean"].kv == pytest.approx(2 * mean * chosen.alpha)
    assert made["salcudean"].kp == pytest.approx(4 * mean**2 * chosen.beta)
    ekf = tuned_estimators(FLAT, 3, SHEET, RATE)["ekf"]
    np.testing.assert_array_equal(made["ekf"].process_cov, ekf.process_cov)
    np.testing.assert_array_equal(made["ekf"].measurement_cov, ekf.measurement_cov)
    np.testing.assert_array_equal(made["ekf"].initial_velocity_std, ekf.initial_velocity_std)


# Filters that know no model, tuned on a part of a log.


def trial(noise: float, missing: bool = False) -> Trial:
    """Two seconds of a motion that a cubic follows much better than a parabola."""
    t = np.arange(0.0, 3.0, 1 / RATE)
    rng = np.random.default_rng(2)
    y = np.stack([np.sin(6 * t), 0.5 * np.cos(9 * t)], axis=1) + noise * rng.normal(size=(len(t), 2))
    if missing:
        y[rng.random(y.shape) < 0.05] = np.nan
    return Trial(t, y, np.stack([6 * np.cos(6 * t), -4.5 * np.sin(9 * t)], axis=1))


def trial_error(observer, part: Trial) -> float:
    """Velocity error of an observer, run in earnest, as a part of the velocity."""
    x = np.asarray(run(observer, Record(part.t, np.zeros((len(part.t), 0)), part.y)).estimate)
    late = part.t > part.t[0] + 1.0
    relative = np.mean((x[late, 2:] - part.v[late]) ** 2, axis=0) / np.mean(part.v[late] ** 2, axis=0)
    return float(np.sqrt(relative.mean()))


def test_for_the_motion_of_the_data_sheet_no_linear_filter_is_better_than_a_joints_kalman_filter():
    """Not another of its kind, nor the best of another kind; the numbers of the sheet are taken as they are."""
    told = joint_noise(SHEET, RATE)
    assert told == (SHEET.motion_std, SHEET.motion_time, SHEET.measurement_std)

    def error(observer):
        return linear_filter_error(observer.weights(RATE), SHEET, RATE)

    least = error(JointKalman(*told))
    for factor in (0.5, 0.8, 1.25, 2.0):
        assert error(JointKalman(factor * told[0], *told[1:])) > least
        assert error(JointKalman(told[0], factor * told[1], told[2])) > least
    for kind in (FilteredDerivative, PLL, HighGain):
        assert error(kind(filter_bandwidth(SHEET, RATE, kind=kind))) > least
    assert error(SavitzkyGolay(*polynomial(SHEET, RATE))) > least
    assert jerk_bound(SHEET) == SHEET.motion_std / SHEET.motion_time


def test_long_weights_filter_as_short_ones_do():
    rng = np.random.default_rng(0)
    weights, x = rng.normal(size=99), rng.normal(size=400)
    padded = np.append(weights, np.zeros(500))
    np.testing.assert_allclose(filtered(padded, x), filtered(weights, x), rtol=0, atol=1e-12)
    np.testing.assert_allclose(filtered(weights, x)[-1], weights @ (x[:-100:-1] - x[0]), rtol=1e-12)


def test_an_error_on_a_trial_is_that_of_the_filter_itself():
    part = trial(1e-3)
    predicted = filter_error(SavitzkyGolay(15, 2).weights(RATE), SHEET, RATE, part)
    assert predicted == pytest.approx(trial_error(SavitzkyGolay(15, 2), part), rel=0.01)
