"""Streams and logs through compiled C: what JAX does, whatever the samples are: what takes long."""

import ctypes
import functools
import math
import mmap
import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_engine import RATE, gated, parts, pendulum, record

from covariant import models, observers
from covariant.engine import Stream, _choice, _log, choose, run_log, run_logs
from covariant.engine._choice import FEWEST_ROWS
from covariant.engine._kernel import KernelForm, _prepared, prepared
from covariant.observers import run
from covariant.signals import Record, StepCode

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")


def same(through_c, through_jax):
    for ours, theirs in zip(through_c, through_jax, strict=True):
        for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.exhaustive
@needs_compiler
def test_many_logs_and_many_gains_are_each_that_through_jax():
    logs = parts((150, 600, 320))
    told, engine = run_logs(gated(), logs, engine="c")
    assert engine == "c"
    same(told, [run(gated(), log) for log in logs])
    gains = [observers.Intrinsic(pendulum(), alpha, alpha**2) for alpha in (10.0, 20.0, 5.0)]
    for given in (logs[1], logs):
        told, engine = run_logs(gains, given, ("result",), engine="c")
        assert engine == "c"
        each = given if isinstance(given, list) else [given] * 3
        same(told, [run(observer, log, ("result",)) for observer, log in zip(gains, each, strict=True)])
    heavier = models.pendulum_chain((1.0, 3.0), viscous=(0.1, 0.1), coulomb=(0.05, 0.02))
    told, _ = run_logs([gains[0], observers.Intrinsic(heavier, 10.0, 100.0)], logs[0], ("result",), engine="c")
    same(told[1:], [run(observers.Intrinsic(heavier, 10.0, 100.0), logs[0], ("result",))])


def before_a_wall(array: np.ndarray) -> np.ndarray:
    """A copy that ends where memory does: who reads beyond it is stopped by the processor."""
    size = mmap.PAGESIZE
    assert array.nbytes <= size
    pages = mmap.mmap(-1, 2 * size)
    start = ctypes.addressof(ctypes.c_char.from_buffer(pages))
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(start + size), ctypes.c_size_t(size), 0) == 0
    copy = np.frombuffer(pages, array.dtype, array.size, size - array.nbytes).reshape(array.shape)
    copy[:] = array
    return copy


@pytest.mark.exhaustive
@needs_compiler
def test_runs_in_lanes_are_those_of_jax_each(monkeypatch):
    """Of different lengths and numbers of substeps, more than the lanes; one that is lost stays alone with it."""
    monkeypatch.setattr(_log, "RUNS_A_CORE", 0)
    cuts = [slice(k, k + 150) for k in range(10, 450, 50)]
    logs = [record(), *(Record(*(a[cut] for a in record()[:3])) for cut in cuts)]
    logs[3] = logs[3]._replace(y=np.where(np.arange(150)[:, None] < 1, logs[3].y, np.nan))
    logs[5] = logs[5]._replace(u=np.where(np.arange(150)[:, None] < 75, logs[5].u, 1e300))
    if sys.platform == "linux":
        logs[9] = logs[9]._replace(y=before_a_wall(logs[9].y))  # done beside the longest
    told, engine = run_logs(gated(), logs, engine="c")
    assert engine == "c"
    same(told, [run(gated(), log) for log in logs])
    results = [set(np.asarray(one.info.result).tolist()) for one in told]
    assert [StepCode.NOT_FINITE in each for each in results] == [k == 5 for k in range(10)]


@needs_compiler
def test_the_engine_is_chosen_by_one_rule_and_says_why(monkeypatch, tmp_path):
    observer, form = observers.Intrinsic(pendulum(), 10.0, 100.0), KernelForm((2,), 2)

    def chosen(rows, asked="auto", form=form):
        return str(choose(observer, form, rows, asked))

    _prepared.cache_clear()
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    assert [chosen(10, "c"), chosen(FEWEST_ROWS), chosen(math.inf)] == ["c"] * 3
    assert chosen(10) == "jax: fewer than 100000 rows, and compiled C would not be kept"
    assert chosen(math.inf, "jax") == "jax: as asked"
    assert chosen(math.inf, "c", KernelForm((2,), 2, real=False)) == "jax: measurements are complex numbers"
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    _prepared.cache_clear()
    assert chosen(10) == "c"
    _prepared.cache_clear()
    monkeypatch.setattr(_choice, "missing", lambda: "there is no C compiler")
    assert chosen(math.inf, "c") == "jax: there is no C compiler"


@pytest.mark.exhaustive
@needs_compiler
def test_an_equal_observer_is_compiled_once():
    made = [prepared(observers.Intrinsic(pendulum(), a, 100.0), KernelForm((2,), 2)).kernel for a in (10.0, 10.0, 11.0)]
    assert made[0] is made[1]
    assert made[0] is not made[2]
    first, *rest = (observers.Intrinsic(pendulum(), a, 10 * a) for a in (10.0, 10.0, 11.0, 12.0))
    run_logs([first, rest[1]], parts((100,)), ("result",), engine="c")
    count = _prepared.cache_info().misses
    for each in rest:
        found, _ = run_logs(each, parts((100,)), ("result",), engine="c", others=[first, rest[1]])
    assert _prepared.cache_info().misses == count
    same(found, [run(rest[-1], parts((100,))[0], ("result",))])


MODEL_FILE = """
system = "pendulum_chain"
parameters = {{mass = [{mass}], length = [{length}], viscous = [0.1]}}
"""


@pytest.mark.exhaustive
@needs_compiler
def test_after_another_number_in_the_model_file_nothing_is_compiled(tmp_path, monkeypatch):
    """Neither traced, nor lowered, nor compiled; and the estimates are those of the model with that number."""
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path / "cache"))
    t = np.arange(100) * 0.02
    log = Record(t, np.zeros((100, 1)), 0.3 * np.cos(2 * t)[:, None])
    counts, path = [], tmp_path / "pendulum.toml"
    for mass, length in ((1.5, 0.6), (1.7, 0.8)):
        path.write_text(MODEL_FILE.format(mass=mass, length=length))
        observer = observers.ModelCopy(models.load(path).model, 8.0, 20.0)
        done, engine = run_log(observer, log, engine="c")
        assert engine == "c"
        stream = Stream(observer, log.y[0], 50.0, 1)
        streamed = [stream.step(*row) for row in zip(log.t, log.y, log.u, strict=True)]
        counts.append((_prepared.cache_info().misses, len(list((tmp_path / "cache").rglob("*")))))
    assert counts[0] == counts[1]
    same([done], [run(observer, log)])
    np.testing.assert_allclose(streamed, done.estimate, rtol=0, atol=1e-12)


@functools.cache
def made(engine: str) -> Stream:
    stream = Stream(gated(), record().y[0], RATE, engine=engine)
    assert stream.engine.startswith(engine)
    return stream


@pytest.fixture(params=["c", "jax"])
def stream(request) -> Stream:
    """A stream by each engine, as if it were new."""
    if request.param == "c" and shutil.which("cc") is None:
        pytest.skip("there is no C compiler, `cc`")
    stream = made(request.param)
    stream.reset()
    return stream


@pytest.mark.exhaustive
def test_a_stream_does_what_the_loop_by_hand_does(stream):
    observer, (t, u, y, _) = stream.observer, record()
    stepped = jax.jit(lambda *a: observer.step(*a))
    state = observer.init(jnp.asarray(y[0]), t[0])
    assert np.isnan(stream.step(t[0] - 1, [math.nan, 0.0])).all(), "it waits for a complete measurement"
    x = stream.step(t[0], y[0])
    for k in range(1, 250):
        state, info = stepped(state, jnp.asarray(u[k - 1]), jnp.asarray(y[k]), jnp.asarray(t[k] - t[k - 1]))
        x = stream.step(t[k], y[k], np.repeat(u[k - 1], 2)[::2] if k % 2 else u[k - 1])  # in one piece, or not
        assert stream.result == info.result
    np.testing.assert_allclose(x, observer.estimate(state), rtol=1e-9, atol=1e-12)
    assert stream.health.results["coasted"] == 4
    assert stream.health.results["outlier"] >= 1


def test_no_sample_raises_and_each_fault_is_counted(stream):
    (t, u, y, _), k = record(), 0
    for k in range(40):
        x = stream.step(t[k], y[k], u[k])
    usual = np.abs(x).max()
    faults = [
        (t[k], y[k], u[k]),  # repeated
        (t[k] - 0.01, y[k], u[k]),  # late
        (math.nan, y[k], u[k]),
        ("now", y[k], None),
        (t[k + 1], [math.inf, y[k][1]], u[k]),
        (t[k + 2], [0.1], u[k]),  # too few numbers
        (t[k + 2] + 1e-4, np.array([0.1]), u[k]),
        (t[k + 3], "nothing", u[k]),
        (t[k + 3] + 1e-4, y[k] * (1 + 1j), u[k]),  # no real numbers
        (t[k + 3] + 2e-4, [True, False], u[k]),
        (t[k + 3] + 3e-4, ["0.1", "0.2"], u[k]),
        (t[k + 3] + 4e-4, np.ma.masked_array([y[k][0], 2e3], [False, True]), u[k]),  # the second one is missing
        (t[k + 4], None, [math.nan, math.inf]),
        (t[k + 5], 1e300 * y[k], u[k]),
    ]
    for sample in faults:
        x = stream.step(*sample)
        assert np.isfinite(x).all()
        assert np.abs(x).max() < 10 * usual
    health = stream.health
    assert health.samples == 40 + len(faults)
    assert (health.late, health.unstamped, health.misshapen) == (1, 2, 6)
    assert health.results["repeated"] == 1
    assert health.results["input_held"] >= 1
    assert sum(health.results.values()) == health.samples


def test_a_long_gap_and_a_clock_that_is_set_back_start_the_estimate_anew(stream):
    t, u, y, _ = record()
    for k in range(20):
        stream.step(t[k], y[k], u[k])
    x = stream.step(t[19] + 100.0, [0.4, 0.3], u[19])
    np.testing.assert_array_equal(x, [0.4, 0.3, 0.0, 0.0])
    for k in range(5):
        x = stream.step(t[20 + k], y[20 + k], u[20])
    np.testing.assert_array_equal(x, [*y[24], 0.0, 0.0])
    assert stream.health.late == 4
    assert stream.health.restarts == 2


def test_estimates_are_arrays_of_their_own(stream):
    t, u, y, _ = record()
    first = stream.step(t[0], y[0], u[0])
    kept = first.copy()
    stream.step(t[1], y[1], u[1])
    np.testing.assert_array_equal(first, kept)


def test_a_sink_gets_every_sample_also_those_out_of_turn():
    t, u, y, _ = record()
    seen = []
    stream = Stream(gated(), y[0], 100.0, sink=lambda *sample: seen.append(sample))
    returned = [stream.step(t[k], y[k], u[k]) for k in (0, 1, 0)]
    assert [(stamp, result) for stamp, _, result in seen] == [
        (t[0], StepCode.OK),
        (t[1], StepCode.OK),
        (t[0], StepCode.STEP_REFUSED),
    ]
    np.testing.assert_array_equal([estimate for _, estimate, _ in seen], returned)
