"""Robots of 7 to 30 joints: time of an observer's right-hand side beside forward dynamics, and of their compilation.

The arms are chains like those in workshops, each joint a quarter turn from the last, without anything that repeats.
`python benchmarks/test_robots.py` prints one table: milliseconds for a thousand at once on one core, seconds of
compilation, and how the ratio of observer to forward dynamics grows.
"""

import itertools
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import scalargraph
from covariant.engine import Stream
from covariant.models import MechanicalSystem, acceleration, pendulum_chain, robots
from covariant.observers import Intrinsic

SIZES = (7, 12, 20, 30)
BATCH = 1000
KINDS = ("forward dynamics", "observer")


def chain(n: int) -> str:
    """An arm of n joints as URDF."""
    rng, rows = np.random.default_rng(n), ['<link name="l0"/>']
    for i in range(1, n + 1):
        x, y, z, mass, *moments = (*rng.uniform(-0.1, 0.1, 3), rng.uniform(1, 4), *rng.uniform(0.01, 0.015, 3))
        inertia = " ".join(f'i{2 * a}="{m:.6f}"' for a, m in zip("xyz", moments, strict=True))
        rows.append(
            f'<link name="l{i}"><inertial><origin xyz="{x:.4f} {y:.4f} {z:.4f}"/><mass value="{mass:.4f}"/>'
            f'<inertia {inertia} ixy="1e-4" ixz="2e-4" iyz="-1e-4"/></inertial></link>'
            f'<joint name="j{i}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/><axis xyz="0 0 1"/>'
            f'<origin xyz="{0.1 * (i % 2)} 0 0.2" rpy="{(-1) ** i * np.pi / 2!r} 0 0"/>'
            '<limit lower="-2" upper="2" effort="50" velocity="2"/><dynamics damping="0.1"/></joint>'
        )
    return f'<robot name="chain{n}">' + "\n".join(rows) + "</robot>"


class Work(NamedTuple):
    """A function and its arguments: a right-hand side of the state, input and measurement."""

    function: Callable
    arguments: tuple


@cache
def arm(n: int) -> MechanicalSystem:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"chain{n}.urdf")
        path.write_text(chain(n), encoding="utf-8")
        return robots.load(path)


def work(kind: str, n: int) -> Work:
    """`(q, v, u, y) ↦` the acceleration, or the rates of an observer's estimate (q, v)."""
    model, zero = arm(n), jnp.zeros(())
    observer = Intrinsic(model, 50.0, 1250.0)
    start = observer.init(jnp.zeros(n))

    def forward(q, v, u, y):
        return acceleration(model, zero, q, v, u)

    def follow(q, v, u, y):
        rate = observer.flow(zero, start._replace(q=q, v=v), u, y)
        return rate.q, rate.v

    q, v, u = (jnp.asarray(part) for part in np.random.default_rng(n).uniform(-1, 1, (3, n)))
    return Work(forward if kind == "forward dynamics" else follow, (q, v, u, q + 0.01))


def operations(kind: str, n: int) -> int:
    """Scalar operations of a lowered right-hand side."""
    return scalargraph.operations(scalargraph.lower(*_flat(work(kind, n))).graph.nodes)


def _flat(given: Work) -> tuple:
    return given.function, *given.arguments


def batched(given: Work) -> Work:
    many = tuple(jnp.broadcast_to(part, (BATCH, *part.shape)) for part in given.arguments)
    return Work(jax.vmap(given.function), many)


def compiled(given: Work) -> Any:
    return jax.jit(given.function).lower(*given.arguments).compile()


@pytest.mark.benchmark(max_time=0.5, warmup=False)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", SIZES)
def test_batched(benchmark, kind, n):
    """A thousand at once: divide by a thousand for the time of one."""
    benchmark.group = f"right-hand sides of arms, {BATCH} at once, n = {n}"
    many = batched(work(kind, n))
    program = compiled(many)
    benchmark(lambda: jax.block_until_ready(program(*many.arguments)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [7, 30])
def test_compilation(benchmark, kind, n):
    """From the Python function to machine code, tracing included."""
    benchmark.group = f"compiling the right-hand side of an arm, n = {n}"

    def afresh():
        jax.clear_caches()
        return compiled(work(kind, n))

    benchmark.pedantic(afresh, rounds=1)


@pytest.mark.benchmark(max_time=0.5, group="robots: a step of a stream from Python")
@pytest.mark.parametrize("name", ["double pendulum", "Panda", "forward dynamics of the Panda by Pinocchio"])
def test_stream(benchmark, name):
    """One Runge-Kutta step with the curvature; `pip install pin` for the last one, which is left out without it."""
    if "Pinocchio" in name:
        pin = pytest.importorskip("pinocchio")
        model = pin.buildModelFromUrdf(str(robots.located("panda")))
        data, zero = model.createData(), np.full(7, 0.1)
        benchmark(lambda: pin.aba(model, data, zero, zero, zero))
        return
    system = pendulum_chain() if name == "double pendulum" else robots.load("panda")
    n = 2 if name == "double pendulum" else 7
    stream = Stream(Intrinsic(system, 50.0, 1250.0, substeps=1), np.full(n, 0.1), 500.0, n, "c")
    y, u, stamps = np.full(n, 0.1), np.zeros(n), itertools.count(0.0, 0.002)
    benchmark(lambda: stream.step(next(stamps), y, u))


def main() -> int:
    """Print the table; 0."""
    print(f"{'joints':>6}{'forward [ms]':>14}{'observer [ms]':>14}{'ratio':>7}{'compiled in [s, CPU]':>22}")
    for n in SIZES:
        times = {}
        for kind in KINDS:
            many = batched(work(kind, n))
            program = compiled(many)
            each = []
            for _ in range(7):
                began = time.process_time()
                jax.block_until_ready(program(*many.arguments))
                each.append(time.process_time() - began)
            times[kind] = min(each)
        arm(n)
        jax.clear_caches()
        began = time.process_time()
        compiled(work("observer", n))
        seconds = time.process_time() - began
        forward, follow = (1e3 * times[kind] for kind in KINDS)
        print(f"{n:>6}{forward:>14.1f}{follow:>14.1f}{follow / forward:>7.2f}{seconds:>22.1f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
