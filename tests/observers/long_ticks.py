"""What takes long of `test_ticks.py`."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_ticks import MODEL

from covariant.calibration import DataSheet, Trial, tuned_estimators
from covariant.models import Lagrangian, Motion, advance, pendulum_chain
from covariant.observers import IntrinsicKalman, run
from covariant.signals import Record
from covariant.verbs.base.inputs import Job, data_sheet, load

DT, TICK, PROCESS = 1e-3, 0.02, 0.05


NONE = jnp.zeros(1)


def counting(quantum=TICK, model=MODEL, n=1):
    """A filter that is told of ticks, with edges that are exact but for a hundredth of one."""
    eye = jnp.eye(n)
    return IntrinsicKalman(model, PROCESS**2 * eye, (quantum / 100) ** 2 * eye, eye, quantum=jnp.full(n, quantum))


def rounded(q, quantum=TICK):
    return jnp.round(q / quantum) * quantum


@eqx.filter_jit
def swing(start, key, steps):
    """Positions and velocities (T,) of a pendulum, accelerated by white noise."""

    def step(motion, key):
        motion = advance(MODEL, 0.0, motion, NONE, DT, 1)
        a, b = PROCESS * DT**0.5 * jax.random.normal(key, (2, 1))
        motion = Motion(motion.q + DT * (a / 2 + b / 12**0.5), motion.v + a)
        return motion, (motion.q[0], motion.v[0])

    return jax.lax.scan(step, Motion(start, jnp.zeros(1)), jax.random.split(key, steps.shape[0]))[1]


@eqx.filter_jit
def followed(observer, y):
    """Estimates (T, 2) and covariances (T, 2, 2) along readings y (T,)."""

    def step(state, reading):
        state, info = observer.step(state, NONE, reading[None], jnp.asarray(DT))
        return state, (observer.estimate(state), observer.cov(state), info.nis)

    return jax.lax.scan(step, observer.init(y[:1]), y[1:])[1]


@eqx.filter_jit
def squares(model, observer, starts, keys, steps):
    """NEES, NIS and squared velocities (runs, T); every line of an encoder is a hundredth of a tick off."""
    n = starts.shape[1]

    def one(start, key):
        printed, key = jax.random.split(key)
        lines = ((jnp.arange(-60.0, 60.0) + 0.5) * TICK)[:, None] + TICK / 100 * jax.random.normal(printed, (120, n))

        def counted(q):
            return (jnp.sum(q[None] > lines, axis=0, dtype=float) - 60) * TICK

        def step(carry, key):
            motion, state = carry
            motion = advance(model, 0.0, motion, jnp.zeros(n), DT, 1)
            a, b = PROCESS * DT**0.5 * jax.random.normal(key, (2, n))
            motion = Motion(motion.q + DT * (a / 2 + b / 12**0.5), motion.v + a)
            state, info = observer.step(state, jnp.zeros(n), counted(motion.q), jnp.asarray(DT))
            error = jnp.concatenate([motion.q, motion.v]) - observer.estimate(state)
            nees = error @ jnp.linalg.solve(observer.cov(state), error)
            return (motion, state), (nees / (2 * n), info.nis / n, motion.v @ motion.v)

        first = Motion(start, jnp.zeros(n)), observer.init(counted(start))
        return jax.lax.scan(step, first, jax.random.split(key, steps.shape[0]))[1]

    return jax.vmap(one)(starts, keys)


def double_pendulum() -> Lagrangian:
    chain = pendulum_chain((1.0, 0.7), (0.5, 0.4))
    return Lagrangian(chain.metric, chain.potential, circles=(0, 1))


def lottery(model, observer, shape, steps):
    starts = np.random.default_rng(0).uniform(0.1, 0.4, shape)
    keys = jax.random.split(jax.random.key(3), shape[0])
    return [np.asarray(a) for a in squares(model, observer, jnp.asarray(starts), keys, jnp.zeros(steps))]


@pytest.mark.exhaustive
@pytest.mark.parametrize(("model", "n", "runs", "settled"), [(MODEL, 1, 1000, 300), (double_pendulum(), 2, 150, 400)])
def test_errors_are_as_large_as_it_says(model, n, runs, settled):
    """One tick in 25 samples: NEES within the bounds that 95 of 100 consistent filters stay in, sample by sample."""
    nees, nis, speed = lottery(model, counting(model=model, n=n), (runs, n), settled + 300)
    assert 1 / 30 < np.sqrt(np.mean(speed) / n) * DT / TICK < 1 / 20
    off = np.abs(nees[:, settled:].mean(axis=0) - 1)
    assert np.mean(off < 1.96 * (2 / (2 * n * runs)) ** 0.5) > 0.9
    assert nis[:, settled:].mean() == pytest.approx(1.0, abs=0.05)


@pytest.mark.exhaustive
def test_at_one_tick_in_twenty_samples_a_model_leaves_a_third_of_the_error_of_the_best_without():
    t = np.arange(8000) * DT
    q, v = (np.asarray(a) for a in swing(jnp.array([0.33]), jax.random.key(5), jnp.zeros(len(t))))
    assert np.sqrt(np.mean(v**2)) * DT / TICK == pytest.approx(1 / 20, rel=0.15)
    y = np.asarray(rounded(q))[:, None]
    record = Record(jnp.asarray(t), jnp.zeros((len(t), 1)), jnp.asarray(y))
    sheet = DataSheet(TICK / 12**0.5, PROCESS / DT**0.5, None, 3.0, 0.2, quantum=TICK)
    line_up = tuned_estimators(MODEL, 1, sheet, 1 / DT, Trial(t, y, v[:, None]))
    late = t > 0.5
    error = {}
    for name in ("pll", "joint-kalman", "levant", "high-gain"):
        error[name] = np.sqrt(np.mean((np.asarray(run(line_up[name], record).estimate)[late, 1] - v[late]) ** 2))
    found = np.asarray(run(counting(), record).estimate)[late, 1]
    error["edges in time"] = np.sqrt(np.mean((edge_timing(t, y[:, 0])[late] - v[late]) ** 2))
    assert np.sqrt(np.mean((found - v[late]) ** 2)) < min(error.values()) / 3, error


def edge_timing(t, y):
    """One tick over the time since the edge before, or less where none came for longer; what low-cost drives do."""
    speed, last, since, out = 0.0, 0, 0.0, []
    for k in range(len(t)):
        ticks = 0 if k == 0 else round((y[k] - y[k - 1]) / TICK)
        since = t[k] - t[last]
        if ticks and since > 0:
            speed, last = ticks * TICK / since, k
        out.append(np.sign(speed) * min(abs(speed), TICK / since) if since > 0 else speed)
    return np.array(out)


@pytest.mark.exhaustive
def test_at_rest_between_two_edges_it_comes_to_rest_too():
    """Neither a staircase nor a drift: the joint stands inside its tick, and the velocity goes to zero."""
    model = Lagrangian(lambda q: jnp.eye(1), dissipation=lambda t, q, v, u: -0.1 * v)
    y = jnp.concatenate([rounded(jnp.linspace(0.0, 0.31, 600)), jnp.full(6000, rounded(jnp.array(0.31)))])
    x = np.asarray(followed(counting(model=model), y)[0])
    assert np.abs(x[300:600, 1] - 0.31 / 0.6).max() < 0.1 * 0.31 / 0.6
    assert np.abs(x[-2000:, 1]).max() < 1e-3
    assert np.abs(x[600:, 0] - y[-1]).max() < 0.52 * TICK


@pytest.mark.exhaustive
def test_a_turn_of_the_reading_is_no_edge_and_missing_readings_are_waited_for():
    t = np.arange(2000) * DT
    q, v = 3.0 + 1.5 * t, np.full(len(t), 1.5)
    free = Lagrangian(lambda q: jnp.eye(1), circles=(0,))
    x = np.asarray(followed(counting(2 * np.pi / 300, free), jnp.asarray(rounded(q, 2 * np.pi / 300)))[0])
    wrapped = np.array((rounded(q, 2 * np.pi / 300) + np.pi) % (2 * np.pi) - np.pi)
    wrapped[700:800] = np.nan
    round_ = np.asarray(followed(counting(2 * np.pi / 300, free), jnp.asarray(wrapped))[0])
    assert np.abs(x[300:, 1] - v[301:]).max() < 0.05
    assert np.abs(round_[300:, 1] - v[301:]).max() < 0.05


@pytest.mark.exhaustive
@pytest.mark.data
@pytest.mark.parametrize(
    ("model", "log"),
    [
        ("dfki_simple_pendulum", "dfki_simple_pendulum/ddp.csv"),
        ("multiarm_single", "multiarm_pendulum/single_small_swing_1kHz.csv"),
    ],
)
def test_ticks_ten_times_coarser_on_a_recorded_log(data_folder, model, log):
    """A swing-up on a geared motor, a small free swing, readings made coarse: told of ticks the filter is better."""
    path = Path(__file__).parents[2] / "examples" / f"{model}.toml"
    loaded = load(Job(str(path), data_folder / log, (), 1, 6.0, {}))
    sheet = data_sheet(loaded.file)
    tick = 10 * sheet.quantum
    record = loaded.record._replace(y=tick * np.round(np.asarray(loaded.record.y) / tick))
    scored, errors = loaded.reference.scored, {}
    for quantum in (tick, None):
        told = sheet._replace(measurement_std=tick / 12**0.5, quantum=quantum)
        made = tuned_estimators(loaded.model, 1, told, loaded.rate, names=("intrinsic-kalman",))["intrinsic-kalman"]
        off = np.asarray(run(made, record).estimate)[scored, 1:] - loaded.reference.v[scored]
        errors[quantum] = np.sqrt(np.mean(off**2))
    assert errors[tick] < 0.9 * errors[None]
