"""Compare one step of observers in C with JAX, from a thousand random and edge states each.

    python tools/compare_c.py [NAME ...] [--states 1000]

Prints for each observer the largest difference of any number of the new state, as a part of what is allowed: ten times
what roundings at random make of it (`covariant.lowering.perturbed`). Exits with 1 where one is larger.
"""

import argparse
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.export import Program
from covariant.geometry import Budget
from covariant.lowering import evaluate, perturbed
from covariant.models import marine
from covariant.observers import Geodesic, Intrinsic, IntrinsicKalman, craft_observer
from covariant.runtime._kernel import kernel

UNIT, LANES, ALLOWED = 2.0**-53, 12, 10.0
FRICTION = {"viscous": (0.05, 0.02), "coulomb": (0.1, 0.05)}
NEWTON = Budget(newton=1, steps=4)

OBSERVERS = {
    "ball and beam": lambda: Intrinsic(models.ball_and_beam(), 8.0, 30.0, substeps=1),
    "double pendulum, friction": lambda: Intrinsic(models.pendulum_chain(**FRICTION), 20.0, 200.0),
    "double pendulum, exact": lambda: Geodesic(models.pendulum_chain(), 20.0, 200.0, NEWTON, substeps=1),
    "double pendulum, Kalman": lambda: IntrinsicKalman(
        models.pendulum_chain(**FRICTION), 1.0, 1e-4 * np.eye(2), 4.0 * np.eye(2), substeps=1
    ),
    "heavy top": lambda: Intrinsic(models.heavy_top(), 10.0, 50.0, substeps=1),
    "Panda": lambda: Intrinsic(models.robots.load("panda"), 20.0, 200.0, substeps=1),
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
    """States near the measurements, each with its own velocity, some at rest."""
    start = jax.vmap(observer.init)(jnp.asarray(y))
    if not hasattr(start, "v"):
        return jax.tree.map(lambda a: a + 0.3 * jnp.asarray(rng.normal(size=a.shape)), start)
    v = 3.0 * rng.normal(size=start.v.shape)
    v[::5] = 0.0
    return start._replace(v=jnp.asarray(v))


def flat(tree, count: int) -> np.ndarray:
    """The numbers (count, k) of a batch of states."""
    return np.concatenate([np.asarray(leaf, float).reshape(count, -1) for leaf in jax.tree.leaves(tree)], axis=1)


def allowed(program: Program, arguments: list[np.ndarray], expected: np.ndarray) -> np.ndarray:
    """How far each number (count, k) may be off."""
    values = [float(v) for each in program.values for v in np.ravel(each)]
    columns = [column[:, None] for column in np.concatenate(arguments, axis=1).T]
    with np.errstate(all="ignore"):
        found = evaluate(program.step, perturbed(UNIT, LANES), [*values, *columns])
        lanes = [np.broadcast_to(np.asarray(each, float), (len(expected), LANES)) for each in found]
        size = np.stack([np.abs(each - each[:, :1]).max(axis=1) for each in lanes[: expected.shape[1]]], axis=1)
    return ALLOWED * (size + UNIT * np.abs(expected)) + 64 * np.finfo(float).tiny


def worst(observer, count: int) -> float:
    """The largest difference between C and JAX as a part of what is allowed."""
    rng = np.random.default_rng(0)
    model = observer.model
    y = measurements(model, count, rng)
    m = models.input_count(model, model.manifold.zero(model.manifold.origin()).shape[0])
    state = states(observer, y, rng)
    near = y + 0.05 * rng.normal(size=y.shape) if y.ndim == 2 else np.roll(y, 1, axis=0)
    near[3::11, ..., 0] = np.nan
    dt, u = rng.uniform(0.001, 0.01, count), rng.normal(size=(count, m))
    dt[::13] = 0.0
    new, _ = jax.jit(jax.vmap(observer.step))(state, jnp.asarray(u), jnp.asarray(near), jnp.asarray(dt))
    expected, before = flat(new, count), flat(state, count)
    made = kernel(observer, y[0], m)
    moved, x, told = before.copy(), np.empty(made.sizes[1]), np.empty(made.sizes[2])
    measured = np.ascontiguousarray(near.reshape(count, -1))
    for k in range(count):
        arrays = (u[k], measured[k], dt[k : k + 1], x, told)
        made.library.kernel_run(made.pointer(moved[k]), 1, *map(made.pointer, arrays))
    found = np.where(np.isnan(expected) & np.isnan(moved), 0.0, np.abs(moved - expected))
    return float((found / allowed(made.program, [before, u, measured, dt[:, None]], expected)).max())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(OBSERVERS)}; all by default")
    parser.add_argument("--states", type=int, default=1000)
    options = parser.parse_args()
    failed = False
    for name in options.names or OBSERVERS:
        start = time.process_time()
        found = worst(OBSERVERS[name](), options.states)
        failed |= not found <= 1.0
        print(f"{name:28} {found:8.3f} of what is allowed   {time.process_time() - start:6.1f} s", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
