"""Laws of every observer in the registry, each on the systems that it fits, with the numbers of one data sheet.

What an observer promises beyond them is put to it in `test_observers` and `test_group_observers`.
"""

import functools
import shutil
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.calibration import DataSheet, tuned_estimators
from covariant.engine import run_log
from covariant.models import (
    MechanicalSystem,
    Motion,
    ball_and_beam,
    duffing,
    free_body,
    input_count,
    load,
    oscillator,
)
from covariant.observers import REGISTRY, AbstractObserver
from covariant.observers.base._protocol import _scan
from covariant.scoring import scored_window
from covariant.signals import Record, Run, StepCode
from covariant.simulation import hold, simulate

ROWS, RATE = 240, 100.0
GAP = slice(120, 150)
SHEET = DataSheet(1e-2, 1.0, 0.01, motion_std=2.0, motion_time=0.3, force_rate=4.0)


class Yardstick(NamedTuple):
    """A system of n velocities, and its motion from x0 seen at irregular stamps: t (T,), u (T, m), y and true v."""

    model: MechanicalSystem
    t: np.ndarray
    u: np.ndarray
    y: np.ndarray
    v: np.ndarray


def yardstick(model: MechanicalSystem, x0: Any, inputs: int) -> Yardstick:
    """Steps of 2 to 18 ms, inputs that change slowly."""
    t = np.cumsum(np.random.default_rng(1).uniform(0.2, 1.8, ROWS)) / RATE
    u = 0.3 * np.sin(3 * t[:, None] + np.arange(inputs))
    true = eqx.filter_jit(simulate)(model, x0, jnp.asarray(t), hold(jnp.asarray(t), jnp.asarray(u)))
    return Yardstick(model, t, u, np.asarray(true.y), velocities(true.x))


def velocities(x: Any) -> np.ndarray:
    """Velocities (T, n) of states or estimates."""
    return np.asarray(x.v) if isinstance(x, Motion) else np.split(np.asarray(x), 2, axis=1)[1]


MODELS = {"ball and beam": ball_and_beam(), "body on SO(3)": free_body((0.9, 1.0, 1.2))}
STARTS = {
    "ball and beam": jnp.array([0.3, 0.1, 0.2, -0.9]),
    "body on SO(3)": Motion(jnp.eye(3), jnp.array([0.3, 0.8, -0.2])),
}
CASES = [(entry, name) for entry in REGISTRY for name, model in MODELS.items() if entry.fits(model)]
each = pytest.mark.parametrize(("entry", "name"), CASES, ids=[f"{entry.name}-{name}" for entry, name in CASES])


@functools.cache
def seen(name: str) -> Yardstick:
    return yardstick(MODELS[name], STARTS[name], {"ball and beam": 1, "body on SO(3)": 3}[name])


class Loop(NamedTuple):
    """An observer, its compiled step `(state, u, y, dt) -> (state, estimate, info)`, and a list of its traces."""

    observer: AbstractObserver
    step: Callable
    traces: list


@functools.cache
def loops(name: str) -> dict[str, Loop]:
    """Every observer that fits, by name; what one test compiles the next one uses."""

    def loop(observer):
        traces = []

        @jax.jit
        def step(state, u, y, dt):
            traces.append(dt)
            state, info = observer.step(state, u, y, dt)
            return state, observer.estimate(state), info

        return Loop(observer, step, traces)

    n = seen(name).v.shape[1]
    return {entry: loop(observer) for entry, observer in tuned_estimators(MODELS[name], n, SHEET, RATE).items()}


def with_a_gap(name: str) -> np.ndarray:
    y = seen(name).y.copy()
    y[GAP] = np.nan
    return y


def followed(entry, name, y):
    """Velocities, innovations and result codes of rows 1 and later, by the loop of the documentation."""
    return followed_once(entry.name, name, y.tobytes())


@functools.cache
def followed_once(entry: str, name: str, measured: bytes):
    watched, (observer, step, _) = seen(name), loops(name)[entry]
    t, u, y = watched.t, watched.u, np.frombuffer(measured, watched.y.dtype).reshape(watched.y.shape)
    state, rows = observer.init(jnp.asarray(y[0]), jnp.asarray(t[0])), []
    for k in range(1, ROWS):  # rows are sliced by NumPy: by JAX it takes longer than the step
        state, x, info = step(state, u[k - 1], y[k], t[k] - t[k - 1])
        rows.append((x, info.innovation, info.result))
    x, innovation, codes = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    return velocities(x), innovation, codes


def relative_error(entry, name, v, rows=slice(-60, None)) -> float:
    """Of the velocities in the last rows, to those of the motion."""
    true = seen(name).v[1:]
    return float(np.sqrt(np.mean((v - true)[rows] ** 2) / np.mean(true**2)))


def allowed(entry) -> float:
    """A filter without a model lags; with a model and no noise nothing remains but the inputs' steps."""
    return (
        0.01 if entry.tuned_by in ("gains", "gains and force", "gains and speed", "noise", "noise or ticks") else 0.15
    )


STARTED = {
    "oscillator at 5 Hz": (oscillator(), jnp.array([1.0, 0.5]), 5.0, 60.0, DataSheet(1e-2, 0.02, speed=(0.7,))),
    "body at 100 Hz": (
        MODELS["body on SO(3)"],
        STARTS["body on SO(3)"],
        100.0,
        8.0,
        DataSheet(1e-2, 0.5, speed=(0.7, 0.7, 0.7)),
    ),
}
"""Systems that move from the first reading on: model, first state, rate [Hz], length [s], and what is known of them."""
IN_MOTION = [(entry.name, name) for name, (model, *_) in STARTED.items() for entry in REGISTRY if entry.fits(model)]

SLOW_ON_GROUPS = (
    *("ekf", "geodesic", "intrinsic-force", "intrinsic-kalman"),
    *("intrinsic2", "lagrangian-metric", "tracking-loop", "ukf"),
)


@functools.cache
def started(name: str):
    """A log with noise, its true velocities and the estimators tuned for it."""
    model, x0, rate, length, sheet = STARTED[name]
    t = np.arange(0.0, length, 1 / rate)
    n = len(sheet.speed)
    u = jnp.zeros((len(t), input_count(model, n)))
    true = eqx.filter_jit(simulate)(model, x0, jnp.asarray(t), hold(jnp.asarray(t), u))
    noise = sheet.measurement_std * np.random.default_rng(3).standard_normal((len(t), n))
    y = jax.vmap(model.manifold.ambient.retract)(true.y, jnp.asarray(noise))
    return Record(t, np.asarray(u), np.asarray(y)), velocities(true.x), tuned_estimators(model, n, sheet, rate)


@pytest.mark.core(3)
@pytest.mark.exhaustive(*(f"{entry}-body at 100 Hz" for entry in SLOW_ON_GROUPS))
@pytest.mark.parametrize(("entry", "name"), IN_MOTION, ids=[f"{entry}-{name}" for entry, name in IN_MOTION])
def test_a_velocity_is_known_as_soon_as_readings_tell(entry, name):
    """In the first second that counts, errors are at most twice those of the second half, though all start at rest."""
    log, true, tuned = started(name)
    run, _ = run_log(tuned[entry], log, engine="jax")
    squares = np.sum((velocities(run.estimate) - true) ** 2, axis=1)
    counts, settled = scored_window(log.t), log.t > log.t[-1] / 2
    first = counts & (log.t < log.t[counts][0] + max(1.0, 10 * (log.t[1] - log.t[0])))
    assert np.mean(squares[first]) <= 4 * np.mean(squares[settled])


@pytest.mark.core(1)
@pytest.mark.exhaustive("body on SO(3)", "ekf", "geodesic", "intrinsic", "intrinsic2", "kalman", "ukf")
@each
def test_missing_measurements_are_coasted_and_said(entry, name):
    v, innovation, codes = followed(entry, name, with_a_gap(name))
    expected = np.full(ROWS, int(StepCode.OK))
    expected[GAP] = StepCode.COASTED
    np.testing.assert_array_equal(codes, expected[1:])
    np.testing.assert_array_equal(innovation[GAP.start - 1 : GAP.stop - 1], 0.0)
    assert np.isfinite(v).all()
    assert relative_error(entry, name, v) < allowed(entry)


@pytest.mark.core(1)
@pytest.mark.exhaustive("body on SO(3)", "copy", "ekf", "geodesic", "intrinsic", "intrinsic2", "kalman", "ukf")
@each
def test_prediction_and_correction_make_the_step(entry, name):
    """And the innovation alone is that of the correction's info, where nothing is missing and where something is."""
    watched, (observer, _, _) = seen(name), loops(name)[entry.name]
    u, dt = jnp.asarray(watched.u[1]), jnp.asarray(0.01)

    @jax.jit
    def both(y):
        start = observer.init(jnp.asarray(watched.y[0]))
        stepped = observer.step(start, u, y, dt)
        predicted = observer.predict(start, u, dt)
        return stepped, observer.correct(predicted, u, y), observer.innovation(predicted, u, y)

    for y in (jnp.asarray(watched.y[1]), jnp.full_like(watched.y[1], jnp.nan)):
        (state, info), (corrected, by_hand), innovation = both(y)
        for field in set(state._fields) - {"last_input"}:  # a step remembers the input, too
            jax.tree.map(np.testing.assert_array_equal, getattr(state, field), getattr(corrected, field))
        jax.tree.map(np.testing.assert_array_equal, info, by_hand)
        np.testing.assert_array_equal(innovation, info.innovation)


def kinds(tree: Any) -> list:
    """Shape, type and strength of type of every array of a state: what a compiled loop is bound to."""
    return [(a.shape, a.dtype, jax.typeof(a).weak_type) for a in jax.tree.leaves(tree)]


@pytest.mark.exhaustive(
    "intrinsic-force-ball and beam", "body on SO(3)", "ekf", "geodesic", "intrinsic2", "kalman", "ukf"
)
@pytest.mark.core(1)
@each
def test_a_loop_is_compiled_once_whatever_the_numbers_are(entry, name):
    """A state has the same form before and after a step, the first one included."""
    watched, (observer, step, traces) = seen(name), loops(name)[entry.name]
    state, made = observer.init(jnp.asarray(watched.y[0])), []
    assert getattr(state, "t", 0.0) == 0.0, "an observer that is told no time starts at zero"
    for dt in (0.01, 0.02, 0.0, np.nan):
        before = kinds(state)
        state, _, _ = step(state, jnp.asarray(watched.u[1]), jnp.asarray(watched.y[1]), jnp.asarray(dt, float))
        assert kinds(state) == before
        made.append(len(traces))
    # The first step may compile, the later ones may not.
    assert made == [made[0]] * 4


@pytest.mark.exhaustive("intrinsic-body on SO(3)", "ekf-body on SO(3)", "geodesic-body on SO(3)", "intrinsic-kalman")
@pytest.mark.core(1)
@pytest.mark.long("intrinsic-body on SO(3)", "intrinsic2-body on SO(3)")
@each
def test_single_precision_stays_single(entry, name):
    watched, (observer, _, _) = seen(name), loops(name)[entry.name]
    cast = jax.tree.map(lambda a: a.astype(np.float32) if eqx.is_inexact_array(a) else a, observer)
    given = [jnp.asarray(a, np.float32) for a in (watched.u[0], watched.y[0], 0.01)]

    def first_step(u, y, dt):
        state, info = cast.step(cast.init(y, dt), u, y, dt)
        return state, info, cast.estimate(state)

    state, info, x = eqx.filter_eval_shape(first_step, *given)
    dtypes = {leaf.dtype for leaf in jax.tree.leaves((state, info, x))}
    assert {dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.inexact)} == {np.dtype(np.float32)}


def test_names_are_unique_and_every_entry_fits_something():
    names = [entry.name for entry in REGISTRY]
    assert len(set(names)) == len(names)
    feet = {"parameters.feet": {"FL_FOOT": [0.0, 0.0, 0.0]}}
    others = duffing(), load("legged_base", {"parameters.path": "quadruped", **feet}).model
    of_states = {entry.name for entry in REGISTRY if any(map(entry.fits, others))}
    assert {entry.name for entry, _ in CASES} | of_states == set(names), "put a system that it fits into MODELS"


# What takes longest to compile on SO(3) is of the same parts as the others.
IN_C = [(entry, name) for entry, name in CASES if name != "body on SO(3)" or entry.name in ("intrinsic", "copy", "ekf")]


def is_as_through_jax(done: Any, observer: AbstractObserver, record: Record, keep: Any) -> bool:
    """Whether a run is arrays of NumPy in the structure, shapes and types of the loop of JAX, codes included."""
    kept = None if keep is None else frozenset(keep)
    estimate, info = eqx.filter_eval_shape(_scan, observer, *map(jnp.asarray, record[:3]), kept)
    expected = Run(jax.ShapeDtypeStruct(record.t.shape, record.t.dtype), estimate, info)
    assert jax.tree.structure(done) == jax.tree.structure(expected)
    pairs = list(zip(jax.tree.leaves(done), jax.tree.leaves(expected), strict=True))
    assert all(a.flags.writeable for a, _ in pairs)
    return all(type(a) is np.ndarray and (a.shape, a.dtype) == (b.shape, b.dtype) for a, b in pairs)


@pytest.mark.core(1)
@pytest.mark.long("copy")
@pytest.mark.exhaustive("body on SO(3)", "ekf", "geodesic", "golay", "intrinsic", "intrinsic2", "joint", "ukf")
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
@pytest.mark.parametrize(("entry", "name"), IN_C, ids=[f"{entry.name}-{name}" for entry, name in IN_C])
def test_compiled_c_does_the_same(entry, name):
    """With its gains as arguments, over a gap; whatever is kept of the info."""
    watched, observer = seen(name), loops(name)[entry.name].observer
    record = Record(watched.t, watched.u, with_a_gap(name))
    for keep in (("innovation", "result"), (), None):
        done, engine = run_log(observer, record, keep, "c")
        assert engine == "c"
        assert is_as_through_jax(done, observer, record, keep)
    v, innovation, codes = followed(entry, name, with_a_gap(name))
    np.testing.assert_allclose(velocities(done.estimate)[1:], v, rtol=0, atol=1e-7 * np.abs(v).max())
    np.testing.assert_allclose(done.info.innovation[1:], innovation, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(done.info.result[1:], codes)
