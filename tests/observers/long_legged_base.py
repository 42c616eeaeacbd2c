"""What takes long of `test_legged_base.py`."""

import importlib.util
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from invariant_filter import rotation, run as invariant_run
from scipy.spatial.transform import Rotation
from test_legged_base import ENCODER as SLIDING, GRAVITY, HIPS, STEP, on_sliding_legs

from covariant import models
from covariant.calibration import diagnose
from covariant.engine import run_log
from covariant.models import robots
from covariant.observers import Delayed, StateNoise, legged_base, run
from covariant.signals import Record, StepCode

GALLERY = Path(__file__).parents[2] / "gallery"


SLIP, THRESHOLD, ENCODER = 1e-3, 5.0, 3e-4


LATE = 2
"""Rows of 2 ms by which encoders are late."""


STANDING = 15.0
"""Load [N] from which a foot counts as standing."""


TUNED = 2800
"""Rows before the errors count: 40 % of a log."""


@pytest.fixture(scope="module")
def trot():
    spec = importlib.util.spec_from_file_location("demo_trot", GALLERY / "demo_trot.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def slippery(trot):
    true = trot.simulate()
    return true, trot.measured(true)


@pytest.fixture(scope="module")
def firm(trot):
    true = trot.simulate(slippery=0.0, seed=2)
    return true, trot.measured(true)


@pytest.fixture(scope="module")
def robot_file(trot, tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "trot.xml"
    path.write_text(trot.robot())
    return path


def model_file(trot, path, **parameters):
    feet = {f"{name}_calf": [0.0, 0.0, -trot.CALF] for name in trot.NAMES}
    noise = {"gyro_noise": trot.GYRO[0] / trot.RATE**0.5, "accelerometer_noise": trot.ACCELEROMETER[0] / trot.RATE**0.5}
    given = {"path": str(path), "feet": feet, "radius": trot.RADIUS, "slip": SLIP, **noise, **parameters}
    numbers = {f"parameters.{key}": value for key, value in given.items()}
    return models.load("legged_base", numbers | {"measurement.std": ENCODER})


def observer_of(file):
    process, encoder, first = (
        jnp.diag(jnp.broadcast_to(jnp.asarray(std), count) ** 2)
        for std, count in (
            (file.process_std, file.dimension),
            (file.measurement_std, len(file.columns.q)),
            (file.initial_std, file.dimension),
        )
    )
    return legged_base(file.model, StateNoise(process, encoder, jnp.asarray(file.initial_state), first, 500.0))


def record_of(read, flags=None, late=0):
    q = np.concatenate([np.repeat(read["q"][:1], late, axis=0), read["q"][: len(read["q"]) - late]])
    u = np.concatenate([read["gyro"], read["accelerometer"]], axis=1)
    return Record(np.arange(len(q)) / 500, u, q if flags is None else np.concatenate([q, flags], axis=1))


def rmse(v, true):
    return np.sqrt(np.mean(np.sum((np.asarray(v)[TUNED:, :3] - true["v"][TUNED:]) ** 2, axis=1)))


def rival(trot, true, read):
    """The invariant filter, with kinematics by MuJoCo and the rates of the joints by a filter of 40 Hz."""
    model = trot.on_floor()
    data, count = mujoco.MjData(model), len(read["q"])
    feet, slopes, spins = np.empty((count, 4, 3)), np.empty((count, 4, 3, 12)), np.empty((count, 4, 3, 12))
    linear, angular = np.zeros((2, 3, model.nv))
    for k, q in enumerate(read["q"]):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *q]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for i, name in enumerate(trot.NAMES):
            geom = model.geom(name)
            feet[k, i] = data.geom_xpos[geom.id]
            mujoco.mj_jac(model, data, linear, angular, feet[k, i], int(geom.bodyid[0]))
            slopes[k, i], spins[k, i] = linear[:, 6:], angular[:, 6:]
    kept, rates = np.exp(-2 * np.pi * 40 / 500), np.zeros_like(read["q"])
    for k in range(1, count):
        rates[k] = kept * rates[k - 1] + (1 - kept) * 500 * (read["q"][k] - read["q"][k - 1])
    return invariant_run(
        read["gyro"],
        read["accelerometer"],
        feet,
        slopes,
        np.einsum("kfij,kj->kfi", spins, rates),
        1 / 500,
        gyro_std=trot.GYRO[0],
        acc_std=trot.ACCELEROMETER[0],
        slip=SLIP,
        encoder=ENCODER,
        gate=THRESHOLD,
        radius=trot.RADIUS,
        attitude=true["R"][0],
        velocity=true["R"][0] @ true["v"][0],
    )


@pytest.mark.exhaustive
def test_anchors_move_as_places_in_the_world_do():
    """Against the motion in the world, which constant readings make a sum of small steps."""
    robot = robots.load("quadruped", floating=True)
    legs = robots.legs(robot.space, {"FL_LOWER_LEG": [0.0, 0.008, -0.16]}, 0.03)
    spin, force, dt, steps = np.array([0.4, -2.0, 3.0]), np.array([1.0, 2.0, 11.0]), 0.02, 1000
    x = np.concatenate([[0.3, -0.2, 0.1], [0.0, 0.0, -9.81], [0.2, 0.1, -0.3], np.zeros(6)])
    R, v, p, anchor, h = np.eye(3), x[:3], np.zeros(3), x[6:9], dt / steps
    each, half = rotation(spin * h), rotation(spin * h / 2)
    for _ in range(steps):
        a = R @ half @ force + x[3:6]
        p, v = p + h * v + h**2 / 2 * a, v + h * a
        anchor, R = anchor + h * np.cross(R @ spin, [0, 0, 0.03]), R @ each
    expected = np.concatenate([R.T @ v, R.T @ x[3:6], R.T @ (anchor - p), np.zeros(6)])
    found = jax.jit(legs.step)(jnp.asarray(x), jnp.concatenate([jnp.asarray(spin), jnp.asarray(force)]), dt)
    np.testing.assert_allclose(found, expected, atol=4e-6)  # the step is of third order in the angle, .07
    q = jnp.linspace(-0.5, 0.9, legs.joints)
    centres, slopes, derivatives, pose = jax.jit(
        lambda q: (
            *legs.feet(q)[::2],
            jax.jacfwd(lambda q: legs.feet(q)[0])(q),
            robot.space.pose(jnp.concatenate([jnp.eye(4).ravel(), q]), "FL_LOWER_LEG"),
        )
    )(q)
    np.testing.assert_allclose(slopes, derivatives, atol=1e-12)
    np.testing.assert_allclose(centres[0], (pose @ jnp.array([0.0, 0.008, -0.16, 1.0]))[:3], atol=1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("floor", ["slippery", "firm"])
def test_it_is_as_accurate_as_an_invariant_filter_and_flags_are_not_needed(trot, floor, request, robot_file):
    true, read = request.getfixturevalue(floor)
    ours = run(observer_of(model_file(trot, robot_file)), record_of(read))
    theirs = rival(trot, true, read)[0]
    assert rmse(ours.estimate, true) <= 1.1 * rmse(theirs, true)
    assert rmse(ours.estimate, true) < 5e-3
    within = np.abs(ours.estimate[500:, :3] - true["v"][500:]) < 1.96 * ours.info.state_std[500:, :3]
    assert 0.93 <= np.mean(within) <= 0.98
    stands = true["load"] > STANDING
    flagged = observer_of(model_file(trot, robot_file, flags=True))
    assert rmse(ours.estimate, true) <= 1.1 * rmse(run(flagged, record_of(read, stands * 1.0)).estimate, true)
    unknown = np.where(np.random.default_rng(0).random(stands.shape) < 0.5, np.nan, stands)
    assert rmse(run(flagged, record_of(read, unknown)).estimate, true) < 5e-3


@pytest.mark.exhaustive
def test_encoders_that_are_late_are_named_and_made_up_for(trot, slippery, robot_file):
    true, read = slippery
    file = model_file(trot, robot_file)
    observer, late = observer_of(file), record_of(read, late=LATE)
    assert not diagnose(file, record_of(read)).findings
    (finding,) = diagnose(file, late).findings
    assert (finding.what, finding.wrong) == ("delay", True)
    assert finding.numbers["delay"] == pytest.approx(2e-3 * LATE, abs=5e-4)
    in_time = rmse(run(observer, record_of(read)).estimate, true)
    assert rmse(run(observer, late).estimate, true) > 2 * in_time
    for delay in (2e-3 * LATE, finding.numbers["delay"]):
        assert rmse(run(Delayed(observer, delay, 500.0), late).estimate, true) <= 1.2 * in_time


@pytest.mark.exhaustive
def test_a_start_within_a_step_does_not_lock_it_out(trot, slippery, robot_file):
    true, read = slippery
    observer, record = observer_of(model_file(trot, robot_file)), record_of(read)
    for start in (785, 896, 1007):
        part = Record(*(each[start : start + 3500] for each in record[:3]))
        found = run(observer, part)
        error = np.linalg.norm(found.estimate[:, :3] - true["v"][start : start + 3500], axis=1)
        assert error[1750:].max() < 0.05


@pytest.mark.exhaustive
def test_missing_encoders_coast_and_c_computes_the_same(trot, slippery, robot_file):
    true, read = slippery
    record = record_of({key: each[:600] for key, each in read.items()})
    record.y[200:230] = np.nan
    record.y[300:310, :3] = np.nan
    two = {"FL_calf": [0.0, 0.0, -trot.CALF], "RR_calf": [0.0, 0.0, -trot.CALF]}
    observer = observer_of(model_file(trot, robot_file, feet=two))
    found = run(observer, record)
    assert (np.asarray(found.info.result)[200:230] == StepCode.COASTED).all()
    assert not np.asarray(found.info.standing)[300:310, 0].any()
    assert np.linalg.norm(found.estimate[-1, :3] - true["v"][599]) < 0.05
    compiled, by = run_log(observer, record, engine="c")
    assert by == "c"
    np.testing.assert_allclose(compiled.estimate, found.estimate, atol=1e-9)


def walk(seed, swinging, count=2500):
    """A log of the model itself, and the truth: a base on sliding legs that moves and turns, with all of its noises."""
    random = np.random.default_rng(seed)
    attitude = Rotation.from_rotvec(random.normal(size=3) * [0.1, 0.1, 1.0])
    v, p, bias = np.zeros(3), np.array([0.0, 0.0, 0.3]), random.normal(size=6) * np.repeat([0.05, 0.4], 3)
    feet, phase, rows, truth = p + attitude.apply(HIPS - [0.0, 0.0, 0.3]), random.uniform(0, 6.28, 6), [], []
    white, drift = np.repeat([5e-4, 5e-3], 3) / STEP**0.5, np.repeat([1e-4, 1e-3], 3) * STEP**0.5
    for k in range(count):
        t, back = k * STEP, attitude.inv()
        moves, waves = np.clip((t - 0.8) / 0.3, 0.0, 1.0), np.sin(np.array([9, 7, 3, 5, 4, 11]) * t + phase)
        level = np.cross(back.apply([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0])
        spin = moves * (waves[:3] * [0.5, 0.4, 0.5] + 0.8 * level)
        spring = -2 * (v - [0.3, 0.0, 0.0]) - np.array([0.0, 0.0, 20.0]) * (p[2] - 0.3)
        force = back.apply(moves * (waves[3:] * [2.0, 2.0, 3.0] + spring) - GRAVITY)
        q = back.apply(feet - p) - HIPS + SLIDING * random.normal(size=(4, 3))
        rows.append([t, *(np.concatenate([spin, force]) + bias + white * random.normal(size=6)), *q.ravel()])
        truth.append([*back.apply(v), *back.apply(GRAVITY), *bias])
        for _ in range(4):
            a = (attitude * Rotation.from_rotvec(spin * STEP / 8)).apply(force) + GRAVITY
            p, v = p + v * STEP / 4 + a * (STEP / 4) ** 2 / 2, v + a * STEP / 4
            attitude = attitude * Rotation.from_rotvec(spin * STEP / 4)
        bias, feet = bias + drift * random.normal(size=6), feet + SLIP * STEP**0.5 * random.normal(size=(4, 3))
        swing = (t - 1.0) % 0.5 / 0.25
        for i in ((0, 3) if swing < 1 else (1, 2)) * (swinging and t > 1):  # towards below the hips
            aim = (p + attitude.apply(HIPS[i]) + 0.1 * v) * [1, 1, 0]
            feet[i] += (aim - feet[i]) * min(1.0, 12 * STEP / (1.02 - swing % 1) * 0.25)
            feet[i, 2] = 0.08 * np.sin(np.pi * (swing % 1))
    rows = np.array(rows)
    return Record(rows[:, 0], rows[:, 1:7], rows[:, 7:]), np.array(truth)


@pytest.mark.long
@pytest.mark.parametrize("swinging", [False, True])
def test_the_bands_hold_on_the_model_itself(swinging, tmp_path):
    observer, ratios, squares = on_sliding_legs(tmp_path), [], []
    for seed in range(8):
        record, true = walk(seed, swinging)
        found = run(observer, record)
        settled = np.concatenate([np.arange(6), np.arange(18, 24)])
        off = np.asarray(found.estimate)[600:, settled] - true[600:]
        ratios.append(off / np.asarray(found.info.state_std)[600:, settled])
        squares.append(np.mean(np.sum(off[:, :3] ** 2, axis=1)))
    ratios = np.array(ratios).reshape(8, -1, 4, 3)
    inside = np.mean(np.abs(ratios) < 1.96, axis=(0, 1, 3))
    assert 0.92 <= inside[0] <= 0.97
    # Biases hardly change within a log, so that eight logs have about two dozen independent errors of each.
    assert inside[1:].min() > 0.85
    assert np.sqrt(np.mean(ratios**2, axis=(0, 1, 3))).max() < 1.3
    assert np.sqrt(np.mean(squares)) < 7e-3
