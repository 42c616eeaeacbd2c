"""Of several faults that look alike the plain one is named, and nothing that it explains."""

from typing import Any

import numpy as np
import pytest

from covariant.calibration import diagnose
from covariant.calibration.diagnosis import later_line
from covariant.calibration.diagnosis._jumps import periods, second_sender
from covariant.logs import Register
from covariant.models import ModelFile, free_body, load
from covariant.signals import Record

MASS, COM, INERTIA, VISCOUS, NOISE = 1.0, 0.25, 0.02, 0.05, 2e-4
STATED = {"mass": MASS, "length": 0.5, "com": COM, "inertia": INERTIA, "viscous": VISCOUS}
T = np.arange(0.0, 6.0, 0.004)
TORQUE = 1.5 * np.sin(2 * T) + 1.0 * np.sin(5 * T + 1) + 0.7 * np.sin(11 * T + 2)


def pendulum(**more: Any) -> ModelFile:
    overrides = {f"parameters.{name}": [value] for name, value in STATED.items()}
    return load("pendulum_chain", overrides | {"measurement.std": NOISE, "uncertainty.acceleration": 0.5} | more)


def swing(t=T, torque=TORQUE, start=0.4, viscous=VISCOUS, coulomb=0.0, gravity=9.81) -> np.ndarray:
    """Angles (T, 1) and speeds of a pendulum by Heun's method, without the library."""
    parts, motion = 8, np.array([start, 0.0])

    def rate(x, u):
        held = u - viscous * x[1] - coulomb * np.tanh(x[1] / 0.02) - MASS * gravity * COM * np.sin(x[0])
        return np.array([x[1], held / (INERTIA + MASS * COM**2)])

    rows = [motion]
    for h, u in zip(np.diff(t) / parts, torque, strict=False):
        for _ in range(parts):
            first = rate(motion, u)
            motion = motion + h / 2 * (first + rate(motion + h * first, u))
        rows.append(motion)
    return np.array(rows)


def read(x: np.ndarray, seed: int = 1) -> np.ndarray:
    return x[:, :1] + NOISE * np.random.default_rng(seed).normal(size=(len(x), 1))


def wrong(file: ModelFile, record: Record) -> list[str]:
    return [each.what for each in diagnose(file, record).findings if each.wrong]


@pytest.mark.long("3", "14.285714285714286")
@pytest.mark.parametrize("parts", [3, 10, 100 / 7])
def test_an_encoder_that_begins_anew_is_named_with_its_period(parts):
    period = 2 * np.pi / parts
    log = Record(T, TORQUE[:, None], read(swing()) % period)
    (found,) = [each for each in diagnose(pendulum(), log).findings if each.wrong]
    assert found.what == "period"
    assert found.line.startswith("[measurement] period = ")
    np.testing.assert_allclose(found.numbers["period"], period, rtol=3e-3 if parts % 1 else 1e-9)


def test_a_full_turn_of_an_angle_and_a_fast_motion_are_no_period():
    x = swing(start=3.0)[:, :1]
    assert x.max() > np.pi
    assert periods(T, np.mod(x + np.pi, 2 * np.pi) - np.pi, np.zeros(1)).tolist() == pytest.approx([2 * np.pi])
    assert (
        wrong(pendulum(), Record(T, TORQUE[:, None], np.mod(read(swing(start=3.0)) + np.pi, 2 * np.pi) - np.pi)) == []
    )
    for motion in (np.sin(40 * T), np.sign(np.sin(5 * T)), np.cumsum(np.random.default_rng(0).normal(size=len(T)))):
        assert periods(T, motion[:, None], np.zeros(1)).tolist() == [0.0]


@pytest.mark.parametrize(
    ("quantum", "unit", "digits"),
    [
        (360 / 4096, 1.0, 2),
        (360 / 4096, np.pi / 180, 2),
        (360 / 1024, 1.0, 1),
        (2e-3 * np.pi, 1.0, 4),
        (0.0123, 1.0, 3),
    ],
)
def test_ticks_are_found_though_few_digits_were_printed(quantum, unit, digits):
    for size in (100.0, 20.0):
        motion = size * quantum * (10 * np.sin(1.7 * T) + 4 * np.sin(4.3 * T))
        printed = np.round(np.round(motion / quantum) * quantum, digits) * unit
        assert Register.of(printed).tick == pytest.approx(quantum * unit, rel=2e-4)


def test_printed_noise_has_no_ticks_but_those_of_its_digits():
    for seed, digits in ((seed, digits) for seed in range(8) for digits in (2, 3, 4)):
        random = np.random.default_rng(seed)
        motion = 1.5 * np.sin(1.7 * T) + random.normal(size=len(T)) * 10 ** random.uniform(-5, -1)
        assert Register.of(np.round(motion, digits)).tick in (0.0, pytest.approx(10.0**-digits))


@pytest.mark.long("True-1", "False-1", "False-4", "True-20")
@pytest.mark.parametrize("every", [1, 4, 20])
@pytest.mark.parametrize("late", [True, False])
def test_rows_of_a_second_sender_are_told_and_nothing_else(every, late):
    x, at = swing()[:, 0], T[::every] + 0.0017
    other = np.interp(at - 0.03, T, x) if late else 1.0 + 0.3 * np.sin(3 * at)
    stamps = np.concatenate([T, at])
    order = np.argsort(stamps)
    y = np.concatenate([x, other])[order] + NOISE * np.random.default_rng(2).normal(size=len(order))
    u = np.concatenate([TORQUE, TORQUE[::every]])[order]
    assert wrong(pendulum(), Record(stamps[order], u[:, None], y[:, None])) == ["several senders"]


def test_outliers_are_no_second_sender():
    random, x = np.random.default_rng(0), swing()[:, 0]
    for share in (0.01, 0.03, 0.1):
        bad = random.random(len(T)) < share
        y = x + NOISE * random.normal(size=len(T)) + bad * (0.3 + np.abs(random.normal(0, 0.5, len(T))))
        assert second_sender(T, y) is None
    assert second_sender(T, np.where(random.random(len(T)) < 0.05, 0.0, x)) is None


def turning(t: np.ndarray) -> np.ndarray:
    """Attitudes (T, 3, 3) about two axes."""
    c, s, one, none = np.cos(t), np.sin(t), np.ones_like(t), np.zeros_like(t)
    about_z = np.array([[c, -s, none], [s, c, none], [none, none, one]]).transpose(2, 0, 1)
    c, s = np.cos(np.sin(2 * t)), np.sin(np.sin(2 * t))
    return about_z @ np.array([[one, none, none], [none, c, -s], [none, s, c]]).transpose(2, 0, 1)


def test_of_a_body_frozen_attitudes_and_stamps_in_another_unit_are_seen():
    file, t = ModelFile("body", free_body((1.0, 2.0, 3.0))), 0.01 * np.arange(500.0)
    attitude, torque = turning(t), np.zeros((500, 3))
    assert diagnose(file, Record(t, torque, attitude)).findings == ()
    for factor, unit in ((1e6, "us"), (1e9, "ns"), (1e4, "ms")):
        (found,) = diagnose(file, Record(factor * t, torque, attitude)).findings
        assert (found.what, found.line) == ("unit of time", f'[units] t = "{unit}"')
    frozen = attitude.copy()
    frozen[200:320] = frozen[200]
    assert wrong(file, Record(t, torque, frozen)) == ["repeated rows"]
    assert wrong(file, Record(t, torque, np.broadcast_to(attitude[3], attitude.shape))) == ["nothing moves"]
    # A body that rests before and after is not frozen, nor is one whose attitude has few digits.
    slow = np.clip(t - 1.5, 0.0, 2.0)
    assert wrong(file, Record(t, torque, turning(slow**2 * (3 - slow) / 2))) == []
    assert wrong(file, Record(t, torque, turning(np.round(0.2 * t, 2)))) == []


@pytest.mark.parametrize(
    ("stated", "written"), [(0.0, "0.004"), (0.01, "0.014"), ([0.01], "[0.014]")], ids=["none", "one", "each"]
)
def test_a_delay_that_is_found_comes_on_top_of_the_stated_one(stated, written):
    file = pendulum(**{"measurement.delay": stated, "inputs.delay": 0.002})
    late, acting = later_line(file, 0.004).split(", or ")
    assert late == f"[measurement] delay = {written} where measurements are late"
    assert acting == "[inputs] delay = 0.006 where inputs act late"
