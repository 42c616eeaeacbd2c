"""Filters that know no model, against matrix exponentials, Riccati equations, SciPy and what their papers promise."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg, signal

from covariant.models import free_body
from covariant.observers import (
    PLL,
    REGISTRY,
    FilteredDerivative,
    HighGain,
    JointKalman,
    Levant,
    SavitzkyGolay,
    run,
)
from covariant.observers.differentiators._levant import MARGIN
from covariant.observers.differentiators._tracking_loop import sampled
from covariant.observers.filters._joint_kalman import singer
from covariant.signals import Record, StepCode

ROWS, RATE = 400, 200.0
LINEAR = {
    "filtered derivative": FilteredDerivative(40.0, (0,)),
    "savitzky-golay": SavitzkyGolay(9, 2, (0,)),
    "pll": PLL(40.0, circles=(0,)),
    "pll3": PLL(40.0, 0.5, 3, circles=(0,)),
    "high-gain": HighGain(60.0, circles=(0,)),
    "joint kalman": JointKalman(20.0, 0.1, 1e-3, (0,), gate=None),
}
LOOPS = {name: LINEAR[name] for name in ("pll", "pll3", "high-gain", "joint kalman")} | {
    "levant": Levant(200.0, circles=(0,))
}
EVEN = np.arange(ROWS) / RATE
IRREGULAR = np.cumsum(np.random.default_rng(4).uniform(2e-3, 8e-3, ROWS))


def states(observer, t, y):
    """Positions (T, 2) and velocities (T, 2); all logs have the same size, so that each observer is compiled once."""
    return np.split(np.asarray(run(observer, Record(t, np.zeros((len(t), 0)), y)).estimate), 2, axis=1)


@pytest.mark.core(1)
@pytest.mark.long("joint kalman")
@pytest.mark.parametrize("name", LINEAR)
def test_weights_are_the_response_to_an_impulse(name):
    """Long after the start, of which nothing is left; one coordinate is on a circle, and the impulse short of π."""
    y = np.zeros((ROWS, 2))
    y[200] = 1.0, -2.0
    _, v = states(LINEAR[name], EVEN, y)
    weights = LINEAR[name].weights(RATE)[:200]
    size = np.abs(weights).max()
    np.testing.assert_allclose(v[200 : 200 + len(weights), 0], weights, rtol=0, atol=1e-5 * size)
    np.testing.assert_allclose(v[200 : 200 + len(weights), 1], -2 * weights, rtol=0, atol=1e-5 * size)


# Tracking loops

LAWS = {
    "pll": (PLL(40.0), [[-2 * 0.5**0.5 * 40, 1], [-(40**2), 0]]),
    "pll, overdamped": (PLL(40.0, 1.3), [[-2 * 1.3 * 40, 1], [-(40**2), 0]]),
    "third order": (PLL(40.0, 0.6, 3), [[-88, 1, 0], [-(40**2) - 48 * 40, 0, 1], [-(40**3), 0, 0]]),
    "high-gain": (HighGain(60.0), [[-180, 1, 0], [-3 * 60**2, 0, 1], [-(60**3), 0, 0]]),
}


@pytest.mark.parametrize("name", LAWS)
def test_sampled_loops_have_the_poles_of_the_continuous_law_and_tend_to_it(name):
    observer, law = LAWS[name]
    gaps = []
    for dt in (0.02, 1e-3, 5e-4):
        step, gain = map(np.asarray, sampled(observer.gains, jnp.asarray(dt)))
        found, exact = step - np.outer(gain, step[0]), linalg.expm(np.array(law) * dt)
        np.testing.assert_allclose(np.poly(found), np.poly(exact), rtol=0, atol=1e-12)
        unit = 40.0 ** np.arange(len(gain))
        gaps.append(np.abs((found - exact) * unit[None, :] / unit[:, None]).max())
    assert gaps[1] / gaps[2] == pytest.approx(4, rel=0.1), "to second order in dt"


@pytest.mark.core(1)
@pytest.mark.parametrize("name", LOOPS)
def test_what_they_assume_of_the_motion_leaves_no_error(name):
    """A ramp; a parabola too where accelerations are followed and do not fade. At irregular stamps."""
    t, late = IRREGULAR, slice(-50, None)
    curve = 3.0 if name in ("pll3", "high-gain", "levant") else 0.0
    truth = np.stack([1 + 2 * t + curve * t**2, -t], axis=1)
    slope = np.stack([2 + 2 * curve * t, -1 + 0 * t], axis=1)
    q, v = states(LOOPS[name], t, truth)
    np.testing.assert_allclose(q[late], truth[late], rtol=0, atol=1e-8)
    np.testing.assert_allclose(v[late], slope[late], rtol=0, atol=1e-6)


@pytest.mark.core(1)
@pytest.mark.parametrize("name", LOOPS)
def test_a_missing_entry_is_a_sample_that_was_never_taken(name):
    """Two steps without a measurement between them are one; the other coordinate notices nothing."""
    rng = np.random.default_rng(1)
    y = np.cumsum(rng.normal(size=(ROWS, 2)), axis=0) * 0.01
    gone = np.zeros(ROWS, bool)
    gone[5:300:3] = gone[101:120] = True
    holed = y.copy()
    holed[gone, 1] = np.nan
    done = run(LOOPS[name], Record(IRREGULAR, np.zeros((ROWS, 0)), holed))
    np.testing.assert_array_equal(np.asarray(done.info.result) == StepCode.COASTED, gone)
    np.testing.assert_array_equal(np.asarray(done.info.innovation)[gone, 1], 0.0)
    _, whole = states(LOOPS[name], IRREGULAR, y)
    # The samples that were taken, and behind them others, which make the log as long as the rest.
    kept, later = np.flatnonzero(~gone), IRREGULAR[-1] + EVEN[1 : gone.sum() + 1]
    _, without = states(LOOPS[name], np.append(IRREGULAR[kept], later), np.concatenate([y[kept], y[: gone.sum()]]))
    v = np.split(np.asarray(done.estimate), 2, axis=1)[1]
    np.testing.assert_allclose(v[kept, 1], without[: len(kept), 1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(v[:, 0], whole[:, 0], rtol=0, atol=1e-12)


@pytest.mark.core(1)
@pytest.mark.parametrize("name", LOOPS)
def test_angles_go_round(name):
    """At 9 rad/s, read between ±π; the second coordinate is no angle."""
    y = np.stack([(9 * IRREGULAR + np.pi) % (2 * np.pi) - np.pi, 9 * IRREGULAR], axis=1)
    q, v = states(LOOPS[name], IRREGULAR, y)
    np.testing.assert_allclose(v[:, 0], v[:, 1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(v[-100:], 9.0, atol=0.02)
    np.testing.assert_allclose(np.sin(q[-100:, 0]), np.sin(y[-100:, 0]), atol=1e-3)


# The Kalman filter of a joint

MOTION = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize("theta", [0.05, 0.3, 1 - 1e-9, 1 + 1e-9, 3.0, 12.0])
def test_singers_acceleration_is_integrated_exactly(theta):
    """By Van Loan's matrix exponential, on both sides of where the series ends.

    What decays makes its blocks large and small, so that it is taken over a short time, which is doubled.
    """
    step, added = map(np.asarray, singer(jnp.asarray(theta)))
    noise, doublings = np.diag([0.0, 0.0, 2.0]), 5
    joint = linalg.expm(np.block([[-MOTION, noise], [np.zeros((3, 3)), MOTION.T]]) * theta / 2**doublings)
    over = joint[3:, 3:].T
    expected = over @ joint[:3, 3:]
    for _ in range(doublings):
        expected, over = expected + over @ expected @ over.T, over @ over
    np.testing.assert_allclose(step, linalg.expm(MOTION * theta), rtol=1e-12)
    np.testing.assert_allclose(added, expected, rtol=1e-9)
    assert np.linalg.eigvalsh(added)[0] > 0


def test_for_short_steps_it_is_white_jerk():
    h = 1e-5
    white = 2 * np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]])
    np.testing.assert_allclose(singer(jnp.asarray(h))[1], white, rtol=1e-4)


@pytest.mark.parametrize("noise", [1e-5, 1e-3, 0.1])
def test_its_steady_gain_is_that_of_the_riccati_equation(noise):
    """From the stationary covariance come the weights; those of the running filter are held to them above."""
    std, time = 20.0, 0.1
    step, added = linalg.expm(MOTION / (RATE * time)), np.asarray(singer(jnp.asarray(1 / (RATE * time)))[1])
    small = (noise / (std * time**2)) ** 2
    cov = linalg.solve_discrete_are(step.T, np.eye(3)[:, :1], added, np.array([[small]]))
    gain = cov[:, 0] / (cov[0, 0] + small)
    weights = JointKalman(std, time, noise).weights(RATE)
    assert weights[0] == pytest.approx(gain[1] / time, rel=1e-6)
    assert weights[1] == pytest.approx(((step - np.outer(gain, step[0])) @ gain)[1] / time, rel=1e-6)


# Levant's differentiator


def test_levant_ends_in_finite_time_and_rests():
    """On a parabola, from a wrong velocity and acceleration; linear loops approach it for ever."""
    t = EVEN
    y = np.stack([3 * t**2 - 2 * t, 0.3 * t**2], axis=1)
    q, v = states(Levant(50.0, circles=(0,)), t, y)
    error = np.abs(v - np.stack([6 * t - 2, 0.6 * t], axis=1))
    assert error[1, 0] > 0.5
    assert error[240:].max() < 1e-11
    assert np.abs(q - y)[240:].max() < 1e-13


def test_levants_error_is_of_second_order_in_dt_within_the_bound_and_only_there():
    frequency = 5.0  # the jerk of its sine is at most 125

    def worst(bound, dt):
        t = dt * np.arange(ROWS)
        y = np.stack([np.sin(frequency * t), np.cos(frequency * t)], axis=1)
        v = states(Levant(bound, circles=(0,)), t, y)[1]
        truth = frequency * np.stack([np.cos(frequency * t), -np.sin(frequency * t)], axis=1)
        return np.abs(v - truth)[ROWS // 2 :].max()

    dts = np.array([0.02, 0.014, 0.01, 0.007])
    errors = [worst(500.0, dt) for dt in dts]
    order = np.polyfit(np.log(dts), np.log(errors), 1)[0]
    assert order == pytest.approx(2.0, abs=0.1)
    assert np.max(errors / (125 * dts**2)) < 1.3
    within = worst(125.0, 0.007)
    assert within < 22 * 125 * 0.007**2, "a bound that just holds costs accuracy, no more"
    assert worst(125 / 4, 0.007) > 4 * within, "a jerk that is four times too large is not followed"


@pytest.mark.parametrize(("margin", "survives"), [(MARGIN, True), (0.9, False)])
def test_no_jerk_within_the_bound_keeps_levant_away(margin, survives):
    """Of jerks ±L that switch with a sign of the error, many at random, in continuous time; errors scaled to size one.

    Below a margin of 1 the jerk is stronger than the term that should hold it.
    """
    rng = np.random.default_rng(0)
    policy, z, grown, h = rng.normal(size=(3, 500)), rng.normal(size=(3, 500)), np.zeros(500), 4e-3
    policy[:, 0] = 1.0, 0.0, 0.0
    for k in range(2500):
        root = np.cbrt(z[0])
        jerk = np.sign(policy[0] * root + policy[1] * np.sign(z[1]) * np.abs(z[1]) ** 0.5 + policy[2] * z[2])
        pull = np.stack(
            [3 * margin ** (1 / 3) * root * np.abs(root), 3 * margin ** (2 / 3) * root, margin * np.sign(z[0])]
        )
        z = z + h * (np.stack([z[1], z[2], jerk]) - pull)
        size = np.maximum(np.maximum(np.abs(root), np.abs(z[1]) ** 0.5), np.abs(z[2]))
        z = z / np.stack([size**3, size**2, size])
        grown += np.log(size) * (k > 1000)
    assert (grown.max() < 0) == survives


# Numbers that make no sense


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.nan, math.inf])
def test_numbers_that_are_not_positive_are_refused(wrong):
    for make, name in (
        (PLL, "PLL: bandwidth"),
        (lambda number: PLL(1.0, number), "PLL: damping"),
        (HighGain, "HighGain: bandwidth"),
        (Levant, "Levant: jerk"),
        (lambda number: JointKalman(number, 1.0, 1.0), "JointKalman: motion_std"),
        (lambda number: JointKalman(1.0, number, 1.0), "JointKalman: motion_time"),
        (lambda number: JointKalman(1.0, 1.0, number), "JointKalman: measurement_std"),
    ):
        with pytest.raises(ValueError, match=f"{name} must be a positive, finite number"):
            make(wrong)


# Derivatives by a filter and by polynomials

STAMPS = jnp.asarray(np.cumsum(np.concatenate([[0.0], np.random.default_rng(0).uniform(1e-3, 4e-3, 300)])))


def test_filters_agree_with_scipy_on_regular_stamps():
    dt, w = 0.01, 25.0
    t = np.arange(80) * dt
    y = np.sin(3 * t)[:, None]
    record = Record(jnp.asarray(t), jnp.zeros((80, 0)), jnp.asarray(y))
    derivative = np.asarray(run(FilteredDerivative(w), record).estimate)[:, 1]
    k = 1 - np.exp(-w * dt)
    expected = signal.lfilter([k], [1, k - 1], np.diff(y[:, 0], prepend=y[0, 0]) / dt)
    assert np.allclose(derivative, expected, atol=1e-12)
    slope = np.asarray(run(SavitzkyGolay(11, 2), record).estimate)[:, 1]
    weights = signal.savgol_coeffs(11, 2, deriv=1, delta=dt, pos=10, use="dot")
    windows = np.lib.stride_tricks.sliding_window_view(y[:, 0], 11)
    assert np.allclose(slope[10:], windows @ weights, atol=1e-6)


def test_a_filtered_derivative_finds_a_ramp_at_its_own_pace_whatever_the_stamps():
    """From rest, the velocity after a step of the slope is (1 − exp(−ωt)) times it, at every measurement."""
    t = np.asarray(STAMPS)
    y = 3.0 * t[:, None] - 1
    y[4:200:5] = np.nan
    v = np.asarray(run(FilteredDerivative(40.0), Record(t, np.zeros((len(t), 0)), y)).estimate)[:, 1]
    seen = np.isfinite(y[:, 0])
    np.testing.assert_allclose(v[seen], 3.0 * -np.expm1(-40.0 * t[seen]), rtol=0, atol=1e-10)
    assert (v[~seen] == v[np.flatnonzero(~seen) - 1]).all()


@pytest.mark.parametrize(("window", "order"), [(3, 3), (2, 2), (5, 0)])
def test_a_window_must_be_longer_than_the_order(window, order):
    with pytest.raises(ValueError, match=f"window {window} must exceed order {order}"):
        SavitzkyGolay(window, order)


def test_a_third_order_loop_with_equal_poles_is_the_high_gain_differentiator():
    dt = jnp.array([2e-3, 0.05])
    same = PLL(60.0, 1.0, 3).gains(dt, dt), HighGain(60.0).gains(dt, dt)
    np.testing.assert_allclose(*same, rtol=1e-9)


def test_about_one_axis_the_loop_on_a_group_is_that_of_the_angle():
    """A turn that accelerates and passes half a turn, with noise, holes and irregular stamps."""
    t = IRREGULAR
    angle = 0.3 + 2 * t + 3 * t**2 + 1e-2 * np.random.default_rng(2).normal(size=len(t))
    angle[50:55] = np.nan
    c, s, o = np.cos(angle), np.sin(angle), 0 * angle
    attitudes = np.stack([np.stack(row, -1) for row in ((c, -s, o), (s, c, o), (o, o, 1 + o))], axis=1)
    entry = next(each for each in REGISTRY if each.name == "tracking-loop")
    loop = entry.construct(free_body((0.9, 1.0, 1.2)), 30.0)
    turned = run(loop, Record(t, np.ones((len(t), 3)), attitudes))  # inputs of the model, which it does not know
    _, v = states(PLL(30.0, 0.5, 3, circles=(0,)), t, angle[:, None])
    np.testing.assert_allclose(np.asarray(turned.estimate.v)[:, 2], v[:, 0], rtol=0, atol=1e-8)
    assert not np.asarray(turned.estimate.v)[:, :2].any()
