"""Compare one step of observers in C with JAX, from a thousand random and edge states each.

    python tools/compare_c.py [NAME ...] [--states 1000] [--real float] [--lanes 8]

Prints for each observer the largest difference of any number of the new state, as a part of what is allowed: ten times
what roundings at random make of it (`scalargraph.perturbed`), in the same precision. Exits with 1 where one is
larger.
"""

import argparse
import sys
import time
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.codegen import Program, program, with_open_numbers
from covariant.engine._compile import library
from covariant.geometry import Budget, Interpolated
from covariant.models import marine
from covariant.observers import Geodesic, Intrinsic, IntrinsicKalman, Riccati, StateEKF, craft_observer
from scalargraph import c_function, c_helpers, c_rows, evaluate, perturbed

LANES, ALLOWED = 12, 10.0
DTYPES = {"double": np.float64, "float": np.float32}
FRICTION = {"viscous": (0.05, 0.02), "coulomb": (0.1, 0.05)}
NEWTON = Budget(newton=1, steps=4)


def looked_up() -> Riccati:
    """The frequency of an oscillation, with a metric that is a table."""
    axes = tuple(np.linspace(low, high, 9) for low, high in ((-2.0, 2.0), (-2.0, 2.0), (0.2, 2.0)))
    spread = np.random.default_rng(0).normal(size=(9, 9, 9, 3, 3))
    field = Interpolated(axes, np.eye(3) + 0.1 * np.einsum("...ij,...kj->...ik", spread, spread))
    return Riccati(models.unknown_frequency(), field, jnp.array([0.5, 0.5, 1.0]), 0.5)


OBSERVERS = {
    "ball and beam": lambda: Intrinsic(models.ball_and_beam(), 8.0, 30.0, substeps=1),
    "double pendulum, friction": lambda: Intrinsic(models.pendulum_chain(**FRICTION), 20.0, 200.0),
    "double pendulum, exact": lambda: Geodesic(models.pendulum_chain(), 20.0, 200.0, NEWTON, substeps=1),
    "double pendulum, Kalman": lambda: IntrinsicKalman(
        models.pendulum_chain(**FRICTION), 1.0, 1e-4 * np.eye(2), 4.0 * np.eye(2), substeps=1
    ),
    "heavy top": lambda: Intrinsic(models.heavy_top(), 10.0, 50.0, substeps=1),
    "Panda": lambda: Intrinsic(models.robots.load("panda"), 20.0, 200.0, substeps=1),
    "frequency, metric in a table": looked_up,
    "Duffing, Kalman": lambda: StateEKF(
        models.duffing(), jnp.eye(2), 1e-4 * jnp.eye(1), jnp.array([0.3, 0.1]), jnp.eye(2), 2
    ),
    "ship": lambda: craft_observer(marine.cybership(), 2.0 * np.eye(3), 2.0 * np.eye(3)),
}
ANGLES = (0.0, np.pi, -np.pi, 20 * np.pi, np.nextafter(np.pi, 0))
"""Angles at the edges: rest, half a turn, ten turns."""


def measurements(model, count: int, rng: np.random.Generator) -> np.ndarray:
    """Configurations (count, …): random ones within ten turns, and some at the edges; on a group anywhere."""
    manifold = model.manifold
    n = manifold.zero(manifold.origin()).shape[0]
    local = rng.uniform(-np.pi, np.pi, (count, n))
    if manifold.commuting:
        local[::3] *= 20
        local[1::7] = rng.choice(ANGLES, (len(local[1::7]), n))
        return local
    return np.asarray(jax.vmap(lambda s: manifold.retract(manifold.origin(), s))(jnp.asarray(local)))


def states(observer, y: np.ndarray, rng: np.random.Generator):
    """States near the measurements, each with its own velocity, some at rest; of a state-space model anywhere."""
    start = jax.vmap(observer.init)(jnp.asarray(y))
    if hasattr(start, "x"):
        return start._replace(x=start.x + rng.normal(size=start.x.shape))
    if not hasattr(start, "v"):
        return jax.tree.map(lambda a: a + 0.3 * jnp.asarray(rng.normal(size=a.shape)), start)
    v = 3.0 * rng.normal(size=start.v.shape)
    v[::5] = 0.0
    return start._replace(v=jnp.asarray(v))


def flat(tree, count: int) -> np.ndarray:
    """The numbers (count, k) of a batch of states."""
    return np.concatenate([np.asarray(leaf, float).reshape(count, -1) for leaf in jax.tree.leaves(tree)], axis=1)


def allowed(made: Program, rows: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """How far each number (count, k) may be off, for arguments (count, …) of a step."""
    dtype = DTYPES[made.real]
    unit = np.finfo(dtype).eps / 2
    with np.errstate(all="ignore"):
        found = evaluate(made.step, perturbed(unit, LANES), [column[:, None] for column in rows.T.astype(float)])
        lanes = [np.broadcast_to(np.asarray(each, float), (len(expected), LANES)) for each in found]
        size = np.stack([np.abs(each - each[:, :1]).max(axis=1) for each in lanes[: expected.shape[1]]], axis=1)
    return ALLOWED * (size + unit * np.abs(expected)) + 64 * np.finfo(dtype).tiny


def in_c(made: Program, rows: np.ndarray, lanes: int) -> np.ndarray:
    """Results (count, …) of a step of C for arguments (count, …)."""
    if lanes > 1:
        source = c_rows(made.step, "rows", lanes, made.real)
    else:
        text = c_function(made.step, "step", real=made.real)
        source = f"#include <math.h>\n{c_helpers(text.helpers, made.real)}\n{text.text}"
    declared = {"rows": f"void rows(const {made.real} *x, {made.real} *y, long long count);"}
    declared["step"] = f"void step(const {made.real} *x, {made.real} *y);"
    ffi, compiled = library(source, declared["rows" if lanes > 1 else "step"])
    rows, found = np.ascontiguousarray(rows), np.empty((len(rows), len(made.step.outputs)), rows.dtype)

    def places(*arrays):
        return (ffi.cast(f"{made.real} *", array.ctypes.data) for array in arrays)

    if lanes > 1:
        compiled.rows(*places(rows, found), len(rows))
    else:
        for before, after in zip(rows, found, strict=True):
            compiled.step(*places(before, after))
    return found


def worst(observer, count: int, real: Literal["double", "float"], lanes: int) -> float:
    """The largest difference between C and JAX as a part of what is allowed."""
    rng, dtype, model = np.random.default_rng(0), DTYPES[real], observer.model
    if isinstance(model, models.StateSpace):
        m, x = model.inputs, rng.uniform(-1.5, 1.5, (count, len(model.coordinates)))
        y = np.asarray(jax.vmap(lambda x: model.h(jnp.zeros(()), x, jnp.zeros(m)))(jnp.asarray(x)))
    else:
        y = measurements(model, count, rng)
        m = models.input_count(model, model.manifold.zero(model.manifold.origin()).shape[0])
    state = states(observer, y, rng)
    near = y + 0.05 * rng.normal(size=y.shape) if y.ndim == 2 else np.roll(y, 1, axis=0)
    near[3::11, ..., 0] = np.nan
    dt, u = rng.uniform(0.001, 0.01, count), rng.normal(size=(count, m))
    dt[::13] = 0.0

    def cast(tree):
        return jax.tree.map(lambda a: jnp.asarray(a, dtype) if eqx.is_inexact_array(a) else a, tree)

    state, u, near, dt = (cast(jax.tree.map(jnp.asarray, each)) for each in (state, u, near, dt))
    new, _ = jax.jit(jax.vmap(cast(observer).step))(state, u, near, dt)
    made = program(with_open_numbers(observer, ("*",)), y[0], m, real, loops=True)
    parts = [flat(state, count), np.asarray(u), np.asarray(near).reshape(count, -1), np.asarray(dt)[:, None]]
    rows = np.concatenate(parts, axis=1).astype(dtype)
    expected = flat(new, count)
    moved = in_c(made, rows, lanes)[:, : expected.shape[1]].astype(float)
    found = np.where(np.isnan(expected) & np.isnan(moved), 0.0, np.abs(moved - expected))
    return float((found / allowed(made, rows, expected)).max())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(OBSERVERS)}; all by default")
    parser.add_argument("--states", type=int, default=1000)
    parser.add_argument("--real", choices=("double", "float"), default="double")
    parser.add_argument("--lanes", type=int, default=1, help="so many states at once; 1 is plain C")
    options = parser.parse_args()
    failed = False
    for name in options.names or OBSERVERS:
        start = time.process_time()
        found = worst(OBSERVERS[name](), options.states, options.real, options.lanes)
        failed |= not found <= 1.0
        print(f"{name:28} {found:8.3f} of what is allowed   {time.process_time() - start:6.1f} s", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
