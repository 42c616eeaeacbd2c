"""The compiled C of an observer beside its compiled program of JAX: a step from Python, and a log."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from moments import moment

from covariant import models
from covariant.engine import Stream, _kernel, _log, compiled, run_log, run_logs
from covariant.geometry import Budget
from covariant.observers import Geodesic, Intrinsic
from covariant.signals import Record

ROWS = 100_000


@pytest.mark.benchmark(max_time=0.5, group="engine: a step from Python, n = 2")
@pytest.mark.parametrize("engine", ["jax", "c"])
def test_step(benchmark, engine):
    """NumPy in and out, as a controller in Python has them."""
    case = moment("intrinsic", 2)
    y, u = np.asarray(case.y), np.asarray(case.u)
    if engine == "c":
        stream = Stream(case.observer, y, 500.0, len(u))
        assert stream.engine == "c"
        stamps = itertools.count(0.0, 0.002)
        benchmark(lambda: stream.step(next(stamps), y, u))
    else:
        step = jax.jit(lambda *moment: case.observer.step(*moment))
        benchmark(lambda: jax.block_until_ready(step(case.state, jnp.asarray(u), jnp.asarray(y), case.dt)))


@pytest.mark.benchmark(max_time=0.5, group="engine: a step of an observer of the Panda in C")
@pytest.mark.parametrize(
    "budget", [None, Budget(0, 1, near=True), Budget(1, 1, near=True)], ids=["first order", "0", "1"]
)
def test_exact_step(benchmark, budget):
    """The observer of first order, and the exact one with so many corrections of its geodesic."""
    panda, y, u = models.robots.load("panda"), np.full(7, 0.1), np.zeros(7)
    gains = (panda, 20.0, 100.0)
    observer = Intrinsic(*gains, substeps=1) if budget is None else Geodesic(*gains, budget, substeps=1)
    stream = Stream(observer, y, 1000.0, 7)
    assert stream.engine == "c"
    stamps = itertools.count(0.0, 0.001)
    benchmark(lambda: stream.step(next(stamps), y, u))


@pytest.mark.benchmark(group=f"engine: a log of {ROWS} rows, n = 2, compilation included")
@pytest.mark.parametrize("engine", ["jax", "c"])
def test_log(benchmark, engine):
    """From a fresh process, but for what the cache folder keeps."""
    case = moment("intrinsic", 2)
    t = np.arange(ROWS) * 0.002
    y = np.stack([0.3 * np.sin(t), 0.5 * np.cos(2 * t)], axis=1)
    record = Record(t, np.zeros((ROWS, len(case.u))), y)

    def work():
        jax.clear_caches()
        _kernel._prepared.cache_clear()
        return run_log(case.observer, record, engine=engine)[0]

    benchmark.pedantic(work, rounds=3)


@pytest.mark.benchmark(group="engine: 100 runs of 10 s at 200 Hz, n = 2, with the gains of each")
@pytest.mark.parametrize("engine", ["jax", "c, one by one", "c, in lanes"])
def test_many_runs(benchmark, engine, monkeypatch):
    """Beside a loop over the compiled program of JAX; the programs are made before."""
    monkeypatch.setattr(_log, "RUNS_A_CORE", 0 if "lanes" in engine else ROWS)
    case = moment("intrinsic", 2)
    t = np.arange(2000) * 0.005
    y = np.stack([0.3 * np.sin(t), 0.5 * np.cos(2 * t)], axis=1)
    record = Record(t, np.zeros((2000, len(case.u))), y)
    gains = [Intrinsic(case.observer.model, a, a**2) for a in np.linspace(5.0, 30.0, 100)]

    def work():
        return run_logs(gains, record, ("result",), engine.partition(",")[0])[0]

    benchmark.pedantic(work, rounds=3, warmup_rounds=1)


@pytest.mark.benchmark(max_time=0.5, group="engine: 1000 forward dynamics of the Panda, under jit(vmap(...))")
@pytest.mark.parametrize("engine", ["jax", "c"])
def test_batch(benchmark, engine):
    panda = models.robots.load("panda")
    states = [jnp.asarray(a) for a in np.random.default_rng(0).uniform(-2, 2, (3, 1000, 7))]

    def rates(q, v, u):
        return models.acceleration(panda, jnp.zeros(()), q, v, u)

    batch = jax.jit(jax.vmap(compiled(rates, *(a[0] for a in states)) if engine == "c" else rates))
    jax.block_until_ready(batch(*states))
    benchmark(lambda: jax.block_until_ready(batch(*states)))
