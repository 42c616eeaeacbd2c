"""A whole log through an observer by compiled C, where it pays."""

import functools
from collections.abc import Collection
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.lowering import LoweringError
from covariant.observers import AbstractObserver, run
from covariant.runtime._compile import missing
from covariant.runtime._kernel import Kernel, chooses, kernel, kernel_of, substeps_needed
from covariant.signals import Record, Result, Run

Engine = Literal["auto", "c", "jax"]
FEWEST_ROWS = 100_000
"""Shortest log for which C is worth its compilation."""
MOST_COUNTS = 6
"""Largest count of different numbers of substeps for which C is made."""


def run_log(
    observer: AbstractObserver, record: Record, keep: Collection[str] | None = None, engine: Engine = "auto"
) -> tuple[Run, str]:
    """As `observers.run`, by C for a long log, and the engine that did it: "c", or "jax" with the reason.

    - `engine`: "c" uses C for a short log too, and "jax" never.

    The results are those of JAX up to rounding. JAX does the work where there is no compiler, and where the observer
    has no graph of fixed length. Raises `ValueError` from `Record.check`.
    """
    if engine == "jax":
        return run(observer, record, keep), "jax: as asked"
    if engine == "auto" and len(record.t) < FEWEST_ROWS:
        return run(observer, record, keep), f"jax: the log is shorter than {FEWEST_ROWS} rows"
    why = missing()
    if why is None:
        try:
            return _by_c(observer, record, keep), "c"
        except (LoweringError, OSError) as error:
            why = f"{error}"
    return run(observer, record, keep), f"jax: {why}"


def _by_c(observer: Any, record: Record, keep: Collection[str] | None) -> Run:
    t, u, y, _ = record.check()
    t, u, y = (np.ascontiguousarray(a, float) for a in (t, u, y))
    acting = np.concatenate([u[:1], u[:-1]])  # the input that acted since the previous stamp
    dt = np.diff(t, prepend=t[:1])
    rows, m = len(t), u.shape[1]
    flat = y.reshape(rows, -1)

    @functools.cache
    def made(count: int) -> Kernel:
        return kernel_of(observer, count, y[0], m) if count else kernel(observer, y[0], m)

    needs = _counter(observer, y[0]) if chooses(observer) else lambda state, u, dt: 0
    count = 1 if chooses(observer) else 0
    first = made(count)
    state = first.start(y[0], float(t[0]))
    _, n_x, n_info = first.sizes
    x, info = np.empty((rows, n_x)), np.empty((rows, n_info))
    at, seen = 0, {count}
    while at < rows:
        chosen = made(count)
        arrays = (acting[at:], flat[at:], dt[at:], x[at:], info[at:])
        done = chosen.library.kernel_run(chosen.pointer(state), rows - at, *map(chosen.pointer, arrays))
        at += done
        if at < rows:
            count = needs(state, acting[at], float(dt[at]))
            seen.add(count)
            if len(seen) > MOST_COUNTS:
                raise LoweringError("the number of substeps changes too often for C")
    return _as_run(observer, first, t, x, info, keep)


def _counter(observer: Any, y: np.ndarray):
    """The number of substeps for a state in one array."""
    shapes = jax.eval_shape(lambda y: observer.init(y), jax.ShapeDtypeStruct(y.shape, float))
    leaves, tree = jax.tree.flatten(shapes)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    count = eqx.filter_jit(substeps_needed)

    def needs(state: np.ndarray, u: np.ndarray, dt: float) -> int:
        parts = zip(np.split(state, ends), leaves, strict=True)
        filled = [jnp.asarray(part.reshape(leaf.shape), leaf.dtype) for part, leaf in parts]
        return int(count(observer, jax.tree.unflatten(tree, filled), jnp.asarray(u), jnp.asarray(dt)))

    return needs


def _as_run(observer: Any, made: Kernel, t, x: np.ndarray, info: np.ndarray, keep: Collection[str] | None) -> Run:
    """The arrays in the form of a run."""
    measured = jax.ShapeDtypeStruct(made.program.y, float)
    state = jax.eval_shape(lambda y: observer.init(y), measured)
    scalar, u = jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct((made.program.u,), float)
    _, kinds = jax.eval_shape(lambda *a: observer.step(*a), state, u, measured, scalar)
    estimate = _split(x, jax.eval_shape(lambda s: observer.estimate(s), state))
    told = _split(info, kinds)
    result = np.asarray(told.result).copy()
    result[0] = Result.OK if result[0] == Result.REPEATED else result[0]  # the first row is no step
    dropped = () if keep is None else set(told._fields) - set(keep)
    return Run(jnp.asarray(t), estimate, told._replace(result=result, **dict.fromkeys(dropped)))


def _split(rows: np.ndarray, kinds: Any) -> Any:
    """Columns of an array as the leaves of a pytree."""
    leaves, tree = jax.tree.flatten(kinds)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    parts = zip(np.split(rows, ends, axis=1), leaves, strict=True)
    return jax.tree.unflatten(tree, [p.reshape(len(rows), *leaf.shape).astype(leaf.dtype) for p, leaf in parts])
