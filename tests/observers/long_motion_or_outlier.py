"""What takes long of `test_motion_or_outlier.py`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from test_motion_or_outlier import CHAIN, NOISE, ROD

from covariant.geometry.lie import SE3
from covariant.models import GroupSystem, Lagrangian, Motion, advance, free_body
from covariant.observers import EKF, UKF, Gate, Gated, Intrinsic, IntrinsicKalman, JointKalman, run
from covariant.observers.base import GateMemory, Sample, Velocity
from covariant.signals import Record, StepCode


def estimator(kind: str, model, speed: float, gate: Gate | None = Gate(), density: float = 1.0):
    """An estimator of the kind, with the noise of the logs here; without a gate where it is None."""
    eye = jnp.eye(len(model.manifold.zero(model.manifold.origin())))
    if kind == "Intrinsic":
        observer = Intrinsic(model, 40.0, 800.0, substeps=2)
        return observer if gate is None else Gated(observer, model, NOISE, speed, gate)
    if kind == "JointKalman":
        return JointKalman(10 * speed, 0.1, NOISE, gate=gate)
    if kind == "IntrinsicKalman":
        return IntrinsicKalman(model, density * eye, NOISE**2 * eye, speed**2 * eye, substeps=2, gate=gate)
    return {"EKF": EKF, "UKF": UKF}[kind](model, density * eye, NOISE**2 * eye, speed, substeps=2, gate=gate)


def followed(observer, t, y):
    found = run(observer, Record(t, np.zeros((len(t), y.shape[1])), y))
    return np.asarray(found.estimate), np.asarray(found.info.result)


def error(estimate: np.ndarray, v: np.ndarray, rows=slice(20, None)) -> float:
    return float(np.sqrt(np.mean((estimate[rows, v.shape[1] :] - v[rows]) ** 2)))


@functools.cache
def bounces(rate: float = 200.0, seconds: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and states of a rod that falls onto a stop at −.5 rad and leaves it at .8 of its speed."""

    def hits(_, x):
        return x[0] + 0.5

    hits.terminal, hits.direction = True, -1
    t = np.arange(0, seconds, 1 / rate)
    x, start, now, done = np.zeros((len(t), 2)), 0.0, np.array([2.0, 0.0]), 0
    while done < len(t):
        part = solve_ivp(
            lambda _, x: [x[1], -9.81 / 0.5 * np.sin(x[0])],
            (start, seconds),
            now,
            events=hits,
            rtol=1e-10,
            atol=1e-12,
            dense_output=True,
        )
        last = np.searchsorted(t, part.t[-1], side="right")
        x[done:last] = part.sol(t[done:last]).T
        start, done = part.t[-1], max(last, done)
        now = np.array([-0.5 + 1e-9, -0.8 * part.y[1, -1]])
        if part.status == 0:
            break
    return t, x


@functools.cache
def swing(rows: int = 2000, start=(2.0, -1.0), v=(0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and states of a double pendulum at 200 Hz."""

    def step(motion, _):
        return advance(CHAIN, 0.0, motion, jnp.zeros(2), 0.005, 8), jnp.concatenate(motion)

    motion = Motion(jnp.array(start), jnp.array(v))
    return 0.005 * np.arange(rows), np.asarray(jax.jit(lambda: jax.lax.scan(step, motion, None, rows)[1])())


def noisy(x: np.ndarray, seed: int = 0) -> np.ndarray:
    n = x.shape[1] // 2
    return x[:, :n] + NOISE * np.random.default_rng(seed).normal(size=(len(x), n))


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["IntrinsicKalman", "Intrinsic", "EKF", "UKF", "JointKalman"])
def test_a_gate_takes_an_impact_for_motion(kind):
    t, x = bounces()
    y, v = noisy(x), x[:, 1:]
    speed = float(np.sqrt(np.mean(v**2)))
    estimates, codes = followed(estimator(kind, ROD, speed), t, y)
    free, _ = followed(estimator(kind, ROD, speed, gate=None), t, y)
    assert (codes == StepCode.RESTARTED).sum() >= 3
    # An impact costs the readings that show it, and gives its velocity at once: one refused reading for each new start.
    assert (codes == StepCode.OUTLIER).sum() <= 1.5 * (codes == StepCode.RESTARTED).sum()
    # A filter without a model follows an impact by itself within two rows, of which the gate refuses one.
    assert error(estimates, v) < (1.12 if kind == "JointKalman" else 1.05) * error(free, v)


@pytest.mark.exhaustive
def test_a_gate_leaves_a_late_joint_alone():
    """One joint is read a row late, so that the model is off by as much as the joint moves in a row."""
    t, x = swing()
    y = noisy(x)
    y[1:, 1] = y[:-1, 1]
    for kind in ("EKF", "Intrinsic", "JointKalman"):
        estimates, codes = followed(estimator(kind, CHAIN, 3.0, density=1e-2), t, y)
        free, _ = followed(estimator(kind, CHAIN, 3.0, gate=None, density=1e-2), t, y)
        assert (codes == StepCode.OUTLIER).sum() == 0
        assert error(estimates, x[:, 2:]) <= 1.05 * error(free, x[:, 2:])


@pytest.mark.exhaustive
def test_a_start_at_full_speed_is_motion():
    """At three times the speed that the filter expects: its first readings agree, and give it the velocity."""
    t, x = swing(start=(0.5, 0.2), v=(9.0, -11.0))
    y, v = noisy(x), x[:, 2:]
    observer = JointKalman(motion_std=30.0, motion_time=0.1, measurement_std=NOISE)
    estimates, codes = followed(observer, t, y)
    assert (codes == StepCode.OUTLIER).sum() <= 2
    assert np.abs(estimates[3, 2:] - v[3]).max() < 2.0


@pytest.mark.exhaustive("EKF-3", "IntrinsicKalman")
@pytest.mark.parametrize("length", [3, 10])
@pytest.mark.parametrize("kind", ["EKF", "IntrinsicKalman"])
def test_a_burst_costs_no_more_than_the_same_rows_missing(kind, length):
    t, x = swing()
    y, v, rng = noisy(x), x[:, 2:], np.random.default_rng(5)
    spoiled, missing = y.copy(), y.copy()
    for k in range(100, len(t), 150):
        spoiled[k : k + length] += rng.uniform(0.2, 0.6, (length, 2)) * rng.choice([-1, 1], (length, 2))
        missing[k : k + length] = np.nan
    gated = estimator(kind, CHAIN, 3.0, density=1e-2)
    estimates, codes = followed(gated, t, spoiled)
    assert StepCode.RESTARTED not in codes
    assert error(estimates, v) < 1.02 * error(followed(gated, t, missing)[0], v)
    assert error(estimates, v) < 1.25 * error(followed(gated, t, y)[0], v)


@pytest.mark.parametrize(
    ("change", "moves"),
    [
        ([0.05, 0.10], True),  # a velocity of 10 from the last used reading on
        ([0.02, 0.07], True),  # the same from between two readings on
        ([0.05, 0.05], False),  # a slip: the readings stay where they are
        ([0.05, -0.05], False),  # to one side and the other
        ([0.09, 0.14], False),  # a slip, and a velocity
        ([0.60, 1.20], False),  # a velocity of 120, where 12 is usual
    ],
)
def test_two_refused_readings_show_a_velocity_where_they_continue_the_last_used_one(change, moves):
    gate, manifold = Gate(), ROD.manifold
    memory, eye = GateMemory.at_start(jnp.zeros(1)), jnp.eye(1)
    for value in change:
        memory = memory.advanced(jnp.asarray(0.005))
        sample = Sample(jnp.array([value]), 1.5 * NOISE**2 * eye, NOISE**2 * eye, jnp.ones(1, bool))
        verdict = gate.judge(manifold, sample, memory, Velocity(jnp.zeros(1), eye), 144.0 * eye)
        memory = verdict.memory
    assert bool(verdict.moved[0]) == moves
    if moves:
        assert float(verdict.velocity.mean[0]) == pytest.approx(10.0)


@pytest.mark.exhaustive
def test_a_spin_is_no_outlier_where_noise_is_given_too_small():
    """A body that turns over about its middle axis; a twentieth of the noise is given, and of the usual speed."""
    body, std = free_body((1.0, 2.0, 3.5)), 2e-3

    def step(motion, _):
        return advance(body, 0.0, motion, jnp.zeros(3), 0.01, 4), motion

    motion = Motion(jnp.eye(3), jnp.array([0.05, 8.0, 0.02]))
    true = jax.jit(lambda: jax.lax.scan(step, motion, None, 400)[1])()
    turns = Rotation.from_rotvec(std * np.random.default_rng(0).normal(size=(400, 3))).as_matrix()
    record = Record(0.01 * np.arange(400), np.zeros((400, 3)), np.asarray(true.q) @ turns)
    filters = (EKF(body, jnp.eye(3), (std / 20) ** 2 * jnp.eye(3), 8.0, substeps=1, gate=g) for g in (Gate(), None))
    gated, free = (np.asarray(run(each, record).estimate.v - true.v)[10:] for each in filters)
    assert np.sqrt(np.mean(gated**2)) <= 1.05 * np.sqrt(np.mean(free**2))


def two_masses(hit: bool) -> tuple[Lagrangian, np.ndarray, np.ndarray, np.ndarray]:
    """Two masses that nothing connects: the sensor of the first slips or, with `hit`, the mass bounces back."""
    masses, t = Lagrangian(lambda q: jnp.eye(2, dtype=q.dtype), coordinates=("a", "b")), 0.005 * np.arange(300)
    first = np.where(t < 0.7, 5 * t, 3.5 - 5 * (t - 0.7)) if hit else 5 * t
    x = np.stack([first, 0.5 * t], axis=1)
    y = x + NOISE * np.random.default_rng(1).normal(size=x.shape)
    y[150:, 0] += 0.0 if hit else 0.3
    return masses, t, x, y


@pytest.mark.exhaustive(
    "EKF-False", "UKF-True", "JointKalman-False", "IntrinsicKalman-False", "Intrinsic-True", "IntrinsicKalman-True"
)
@pytest.mark.parametrize("hit", [True, False])
@pytest.mark.parametrize("kind", ["EKF", "UKF", "IntrinsicKalman", "JointKalman", "Intrinsic"])
def test_a_new_start_takes_no_outlier_of_another_joint(kind, hit):
    masses, t, x, y = two_masses(hit)
    observer = estimator(kind, masses, 2.0, density=1e-2)
    row = np.flatnonzero(followed(observer, t, y)[1][100:] == StepCode.RESTARTED)[0] + 100
    y[row, 1] += 0.4
    estimates, codes = followed(observer, t, y)
    assert codes[row] == StepCode.RESTARTED
    assert (codes[row + 1 : row + 15] == StepCode.OK).all()
    assert np.abs(estimates[row:, 1] - x[row:, 1]).max() < 5 * NOISE


@pytest.mark.exhaustive
def test_a_joint_whose_outlier_is_left_out_stays_as_uncertain_as_predicted():
    masses, t, _, y = two_masses(hit=True)
    observer = estimator("EKF", masses, 4.0)
    row = np.flatnonzero(followed(observer, t, y)[1][100:] == StepCode.RESTARTED)[0] + 100
    y[row - 8 : row + 1, 1] += 0.5 * (-1.0) ** np.arange(9)
    state = observer.init(jnp.array(y[0]))
    step = jax.jit(observer.step)
    for k in range(1, row + 1):
        before = state
        state, info = step(state, jnp.zeros(2), jnp.array(y[k]), 0.005)
    predicted = observer.predict(before, jnp.zeros(2), jnp.asarray(0.005))
    assert int(info.result) == StepCode.RESTARTED
    expected, found = (float(observer.cov(each)[1, 1]) for each in (predicted, state))
    assert expected > 30 * NOISE**2
    assert found == pytest.approx(expected)
    assert state.gate.refused.tolist() == [0, 9]


@pytest.mark.parametrize("kind", ["EKF", "JointKalman"])
def test_an_impact_is_seen_where_joints_are_read_in_turn(kind):
    masses, t, _, y = two_masses(hit=True)
    y[1::2, 0] = np.nan
    y[2::2, 1] = np.nan
    estimates, codes = followed(estimator(kind, masses, 4.0), t, y)
    assert (codes[140:150] == StepCode.RESTARTED).any()
    assert np.abs(estimates[150:, 2] + 5).max() < 1.0


@pytest.mark.exhaustive
def test_a_gap_widens_the_gate_of_each_component_by_its_own_speed():
    """A body whose noisy position hardly moves, and whose spin reverses in a gap of .3 s."""
    body = GroupSystem(SE3, jnp.eye(6), inputs=0, force=lambda t, g, u: jnp.zeros(6))
    t = 0.01 * np.arange(150)
    y = np.tile(np.eye(4), (150, 1, 1))
    angle = np.where(t < 1.15, 3 * t, 3 * (2.3 - t))
    y[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * [0, 0, 1]).as_matrix()
    y[:, :3, 3] = 0.02 * np.random.default_rng(0).normal(size=(150, 3))
    y[100:130] = np.nan
    noise, speed = (jnp.array([a] * 3 + [b] * 3) for a, b in ((0.02, 1e-3), (0.05, 3.0)))
    observer = Gated(Intrinsic(body, 20.0, 200.0, substeps=1), body, noise, speed)
    codes = np.asarray(run(observer, Record(t, np.zeros((150, 0)), y)).info.result)
    assert (codes[130:] == StepCode.OK).all()
