"""A whole log through an observer by compiled C, where it pays."""

from collections.abc import Collection
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from covariant.lowering import LoweringError
from covariant.observers import AbstractObserver, run
from covariant.runtime._compile import missing
from covariant.runtime._kernel import Kernel, kernel
from covariant.signals import Record, Result, Run

Engine = Literal["auto", "c", "jax"]
FEWEST_ROWS = 100_000
"""Shortest log for which C is worth its compilation."""
BLOCK = 10_000
"""Rows whose infos are held at once."""


def run_log(
    observer: AbstractObserver, record: Record, keep: Collection[str] | None = None, engine: Engine = "auto"
) -> tuple[Run, str]:
    """As `observers.run`, by C for a long log, and the engine that did it: "c", or "jax" with the reason.

    - `engine`: "c" uses C for a short log too, and "jax" never.

    The results are those of JAX up to rounding. JAX does the work where there is no compiler, and where the observer
    has no graph. Raises `ValueError` from `Record.check`.
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
    rows, flat = len(t), y.reshape(len(t), -1)
    made = kernel(observer, y[0], u.shape[1])
    state = made.start(y[0], float(t[0]))
    _, n_x, n_info = made.sizes
    paths, _ = jax.tree_util.tree_flatten_with_path(made.program.told_as)
    names = [path[0].name for path, leaf in paths for _ in range(leaf.size)]
    kept = np.flatnonzero([keep is None or name in keep for name in names])
    x, info, block = np.empty((rows, n_x)), np.empty((rows, len(kept))), np.empty((BLOCK, n_info))
    for at in range(0, rows, BLOCK):
        part = slice(at, at + BLOCK)
        count = len(dt[part])
        arrays = (acting[part], flat[part], dt[part], x[part], block)
        made.library.kernel_run(made.pointer(state), count, *map(made.pointer, arrays))
        info[part] = block[:count, kept]
    return _as_run(observer, made, t, x, info, keep)


def _as_run(observer: Any, made: Kernel, t, x: np.ndarray, info: np.ndarray, keep: Collection[str] | None) -> Run:
    """The arrays in the form of a run."""
    measured = jax.ShapeDtypeStruct(made.program.y, float)
    estimate = _split(x, jax.eval_shape(lambda y: observer.estimate(observer.init(y)), measured))
    dropped = () if keep is None else set(made.program.told_as._fields) - set(keep)
    told = _split(info, made.program.told_as._replace(**dict.fromkeys(dropped)))
    if told.result is not None and told.result[0] == Result.REPEATED:
        told.result[0] = Result.OK  # the first row is no step
    return Run(jnp.asarray(t), estimate, told)


def _split(rows: np.ndarray, kinds: Any) -> Any:
    """Columns of an array as the leaves of a pytree."""
    leaves, tree = jax.tree.flatten(kinds)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
    parts = zip(np.split(rows, ends, axis=1), leaves, strict=True)
    return jax.tree.unflatten(tree, [p.reshape(len(rows), *leaf.shape).astype(leaf.dtype) for p, leaf in parts])
