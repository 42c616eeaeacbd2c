"""What takes long of `test_excitation.py`."""

import jax
import numpy as np
import pytest
from test_excitation import HALF, LIMITS, PLAN, SENSING, TRUTH, family, robot
from two_links import accelerate, moved

from covariant import models
from covariant.calibration import design_excitation, fit_robot, motor_inputs
from covariant.calibration.identification import FourierMotion
from covariant.calibration.identification._excitation import _compiled, _Problem
from covariant.calibration.identification._robot_torques import Torques
from covariant.signals import Record


@pytest.fixture(scope="module")
def found(robot):
    return design_excitation(robot, LIMITS, SENSING, PLAN, HALF)


@pytest.mark.exhaustive
def test_limits_are_kept_on_a_grid_ten_times_finer(robot, found):
    t = np.linspace(0, 1 / PLAN.frequency, 10 * 2000 * PLAN.harmonics)
    q, v, a = found.designed.motion.at(t)
    u, motors = motor_inputs(robot.file.model, q, v, a)
    used = LIMITS.used(q, v, u @ motors.T)
    assert used.max() <= PLAN.margin * (1 + 1e-7)
    assert used.max() > 0.98 * PLAN.margin, "something is at its limit"
    np.testing.assert_allclose(used, found.designed.used, rtol=1e-4)
    np.testing.assert_allclose([v[[0, -1]], a[[0, -1]]], 0, atol=1e-9)


@pytest.mark.exhaustive
def test_the_torques_make_another_programs_arm_move_so(robot, found):
    """The closed form of the two links, which shares no line with the robot."""
    q, v, a = found.designed.motion.at(np.linspace(0, 5, 200))
    u, _ = motor_inputs(robot.file.model, q, v, a)
    np.testing.assert_allclose(accelerate(TRUTH, q, v, u), a, atol=1e-8)


@pytest.mark.exhaustive
def test_errors_are_smaller_than_those_of_one_sine_a_joint(found):
    assert found.reference.used.max() <= PLAN.margin
    assert found.reference.used.max() > 0.98 * PLAN.margin, "the plain motion is as large as it may be"
    gain = found.reference.expected.errors / found.designed.expected.errors
    # The determinant is what is maximised: a number may have a larger error, where others gain more.
    assert found.reference.expected.size - found.designed.expected.size > 0.2
    assert np.exp(np.mean(np.log(gain))) > 1.2, gain
    assert gain.min() > 0.6, gain
    assert found.designed.expected.condition < found.reference.expected.condition


@pytest.mark.exhaustive
def test_the_gradient_is_that_of_finite_differences(robot):
    problem = _Problem.of(robot, LIMITS, SENSING, PLAN, HALF)
    evaluate = _compiled(problem)
    x = problem.start(problem.places()[0], 0)
    window = problem.expected(problem.motion(x)).window.arrays(problem.points, PLAN.frequency)
    point = evaluate(x, window)
    step = 1e-5
    for direction in np.random.default_rng(1).normal(size=(3, len(x))):
        ahead, behind = (evaluate(x + sign * step * direction, window) for sign in (1, -1))
        slope = (ahead.value - behind.value) / (2 * step)
        np.testing.assert_allclose(point.slope @ direction, slope, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(point.slack_slope @ direction, (ahead.slack - behind.slack) / (2 * step), atol=1e-4)
    assert point.slack.min() > 0
    np.testing.assert_allclose(problem.coordinates(problem.motion(x)), x, atol=1e-12)


@pytest.mark.exhaustive
def test_the_bounds_of_the_search_are_not_below_the_largest_values(robot):
    problem = _Problem.of(robot, LIMITS, SENSING, PLAN, HALF)
    x = problem.start(problem.places()[0], 0)
    window = problem.expected(problem.motion(x)).window.arrays(problem.points, PLAN.frequency)
    slack = np.asarray(_compiled(problem)(x, window).slack).reshape(3, 2)
    used = problem.used(problem.motion(x), problem.limits, 20)
    assert (slack <= 1 - used + 1e-12).all()
    assert (slack >= 1 - used - 0.06).all()


@pytest.mark.exhaustive
def test_seeds_repeat(robot, found):
    again = design_excitation(robot, LIMITS, SENSING, PLAN, HALF)
    np.testing.assert_array_equal(again.designed.motion.coefficients, found.designed.motion.coefficients)
    other = design_excitation(robot, LIMITS, SENSING, PLAN._replace(seed=1), HALF)
    assert np.abs(other.designed.motion.coefficients - found.designed.motion.coefficients).max() > 0.01


@pytest.mark.exhaustive
def test_what_no_motion_shows_is_named():
    robot = family("inertia.lower")
    found = design_excitation(robot, LIMITS, SENSING, PLAN._replace(harmonics=2), HALF)
    assert found.designed.expected.combinations.rank < 10
    # A plane arm feels the inertia about its axis alone: others follow from mass and place, and that all are physical.
    assert not found.designed.expected.determined[robot.names.index("inertia.lower.ixx")]
    assert "inertia.lower.Ixx" in found.designed.expected.combinations.absorbed


@pytest.mark.exhaustive
def test_limits_that_cannot_be_kept_are_refused(robot):
    weak = LIMITS._replace(low=np.array([0.8, -1.5]), effort=np.array([0.5, 1.0]))
    with pytest.raises(ValueError, match=r"cannot hold the joints still .* joint 'shoulder' takes .* larger effort"):
        design_excitation(robot, weak, SENSING, PLAN, HALF)
    with pytest.raises(ValueError, match=r"duration: a fit needs a log of 2.22 s, and this one has 2 s"):
        design_excitation(robot, LIMITS, SENSING, PLAN._replace(duration=2.0, frequency=0.5), HALF)


def tracked(motion: FourierMotion, model, rate: float, seconds: float):
    """Log of the true arm that follows a motion: feed-forward of a model, and a feedback that corrects its errors."""
    t = np.arange(round(rate * seconds) + 1) / rate
    wanted, wanted_v, wanted_a = motion.at(t)
    forward, _ = motor_inputs(model, wanted, wanted_v, wanted_a)
    q, v = wanted[:1].copy(), wanted_v[:1].copy()
    y, u = np.empty_like(wanted), np.empty_like(wanted)
    gains = np.array([60.0, 15.0]), np.array([3.0, 0.8])
    for k in range(len(t)):
        y[k] = q[0]
        u[k] = forward[k] + gains[0] * (wanted[k] - q[0]) + gains[1] * (wanted_v[k] - v[0])
        q, v = moved(TRUTH, q, v, u[k : k + 1], 1 / rate / 4, 4)
    return t, u, y


@pytest.mark.exhaustive
def test_fits_to_simulated_logs_scatter_as_expected(monkeypatch):
    """An arm with other friction and rotors than the model of the design, in closed form, with feedback and noise."""
    rough = models.robot_family("double_pendulum", ["friction", "armature"])
    plan = PLAN._replace(duration=20.0)
    found = design_excitation(rough, LIMITS, SENSING, plan, HALF)
    compiled = Torques.of(rough)  # once for all fits
    monkeypatch.setattr(Torques, "of", staticmethod(lambda family: compiled))
    truth = np.array([getattr(TRUTH, k)[j] for j in range(2) for k in ("viscous", "coulomb", "asymmetry")])
    truth = np.concatenate([truth, TRUTH.armature])
    scatter = {}
    for name, motion, expected in (
        ("designed", found.designed.motion, found.designed.expected.errors),
        ("reference", found.reference.motion, found.reference.expected.errors),
    ):
        t, u, y = tracked(motion, rough.file.model, SENSING.rate, plan.duration)
        fits = []
        for seed in range(20):
            rng = np.random.default_rng(seed)
            noisy = Record(
                t, u + SENSING.torque_noise * rng.normal(size=u.shape), y + SENSING.noise * rng.normal(size=y.shape)
            )
            fits.append(fit_robot(rough, [noisy], HALF).values)
        errors = np.array(fits) - truth
        scatter[name] = np.sqrt(np.mean(errors**2, axis=0))

        ratio = scatter[name] / expected
        assert (ratio > 1 / 1.5).all(), ratio
        assert (ratio < 1.5).all(), ratio
    assert np.exp(np.mean(np.log(scatter["reference"] / scatter["designed"]))) > 1.2
    jax.clear_caches()
