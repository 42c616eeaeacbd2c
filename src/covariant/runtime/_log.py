"""Whole logs through an observer by compiled C, where it pays."""

import functools
import os
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
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
"""Fewest rows, of all logs together, for which C is worth its compilation."""
BLOCK = 10_000
"""Rows whose infos are held at once."""


def run_log(
    observer: AbstractObserver, record: Record, keep: Collection[str] | None = None, engine: Engine = "auto"
) -> tuple[Run, str]:
    """As `observers.run`, by C for a long log, and the engine that did it: "c", or "jax" with the reason.

    - `engine`: "c" uses C for a short log too, and "jax" never.

    The results are those of JAX up to rounding. JAX does the work where there is no compiler, and where the observer
    has no graph. Raises `ValueError` from `Record.check` and for an unknown engine.
    """
    (done,), name = run_logs(observer, record, keep, engine)
    return done, name


def run_logs(
    observers: AbstractObserver | Sequence[AbstractObserver],
    records: Record | Sequence[Record],
    keep: Collection[str] | None = None,
    engine: Engine = "auto",
) -> tuple[list[Run], str]:
    """Many runs: one observer over many logs, many observers over one log, or as many observers as logs in pairs.

    - `observers`: of one kind, told apart by their numbers, such as gains or masses; all are one compiled program.
    - `records`: logs of any lengths, with measurements and inputs of one shape.
    - `keep`, `engine`: as for `run_log`; C pays if all logs together are long. It uses every core.

    Returns the runs in order, and the engine that made them. Raises `ValueError` from `Record.check`, for counts that
    do not fit, and for observers or records of different forms.
    """
    if engine not in get_args(Engine):
        raise ValueError(f"engine must be one of {', '.join(get_args(Engine))}; got {engine!r}")
    many = [observers] if isinstance(observers, AbstractObserver) else list(observers)
    logs = [r.check() for r in ([records] if isinstance(records, Record) else records)]
    if not many or not logs or (1 not in (len(many), len(logs)) and len(many) != len(logs)):
        raise ValueError(
            f"run_logs needs one observer, one record, or as many of both; got {len(many)} observers "
            f"and {len(logs)} records"
        )
    forms = {(np.shape(r.y)[1:], np.shape(r.u)[1]) for r in logs}
    if len(forms) > 1:
        told = ", ".join(f"y {y} and {u} inputs" for y, u in sorted(forms, key=str))
        raise ValueError(f"run_logs: measurements and inputs must have one shape in all records; got {told}")
    count = max(len(many), len(logs))
    differ, numbers = _told_apart(many)
    each, logs = many * (count // len(many)), logs * (count // len(logs))
    rows = sum(len(r.t) for r in logs)
    why = "as asked" if engine == "jax" else missing()
    if engine == "auto" and rows < FEWEST_ROWS:
        why = f"fewer than {FEWEST_ROWS} rows"
    if why is None:
        try:
            return _by_c(each, differ, np.resize(numbers, (count, numbers.shape[1])), logs, keep), "c"
        except (LoweringError, OSError) as error:
            why = f"{error}"
    return [run(observer, record, keep) for observer, record in zip(each, logs, strict=True)], f"jax: {why}"


def _told_apart(observers: Sequence[AbstractObserver]) -> tuple[tuple[int, ...], np.ndarray]:
    """Which arrays of observers differ, and their numbers, a row for each observer.

    Raises `ValueError` where the observers differ in more than the values of their arrays.
    """
    parts = [eqx.partition(observer, eqx.is_inexact_array) for observer in observers]
    leaves, trees = zip(*(jax.tree.flatten(arrays) for arrays, _ in parts), strict=True)
    shapes = [[np.shape(a) for a in arrays] for arrays in leaves]
    for k, (_, rest) in enumerate(parts):
        if trees[k] != trees[0] or shapes[k] != shapes[0] or not eqx.tree_equal(rest, parts[0][1]):
            raise ValueError(
                f"run_logs: observer {k} is of another kind than the first, not only of other numbers; run it alone"
            )
    columns = [np.stack([np.ravel(arrays[i]) for arrays in leaves]).astype(float) for i in range(len(leaves[0]))]
    differ = tuple(i for i, column in enumerate(columns) if (column != column[0]).any())
    return differ, np.concatenate([np.empty((len(parts), 0)), *(columns[i] for i in differ)], axis=1)


def _by_c(
    observers: Sequence[AbstractObserver],
    differ: tuple[int, ...],
    numbers: np.ndarray,
    logs: Sequence[Record],
    keep: Collection[str] | None,
) -> list[Run]:
    made = kernel(observers[0], np.asarray(logs[0].y[0]), np.shape(logs[0].u)[1], differ)
    form = _Form.of(observers[0], made, keep)
    with ThreadPoolExecutor(min(len(logs), os.cpu_count() or 1)) as pool:  # C lets go of Python's lock while it runs
        return list(pool.map(functools.partial(_through, made, form), numbers, logs))


class _Form(NamedTuple):
    """How columns of numbers become a run.

    - `kept`: the columns of an info that are kept; `estimate`, `told`: `(T, columns) -> pytree`.
    """

    kept: np.ndarray
    estimate: Callable[[np.ndarray], Any]
    told: Callable[[np.ndarray], Any]

    @classmethod
    def of(cls, observer: Any, made: Kernel, keep: Collection[str] | None) -> "_Form":
        """The form of the runs of an observer."""
        paths, _ = jax.tree_util.tree_flatten_with_path(made.program.told_as)
        names = [path[0].name for path, leaf in paths for _ in range(leaf.size)]
        kept = np.flatnonzero([keep is None or name in keep for name in names])
        dropped = () if keep is None else set(made.program.told_as._fields) - set(keep)
        measured = jax.ShapeDtypeStruct(made.program.y, float)
        estimate = jax.eval_shape(lambda y: observer.estimate(observer.init(y)), measured)
        return cls(kept, _split(estimate), _split(made.program.told_as._replace(**dict.fromkeys(dropped))))


def _through(made: Kernel, form: _Form, numbers: np.ndarray, record: Record) -> Run:
    """One log through a kernel with the open numbers given."""
    t, u, y = (np.ascontiguousarray(a, float) for a in record[:3])
    acting = np.concatenate([u[:1], u[:-1]])  # the input that acted since the previous stamp
    dt = np.diff(t, prepend=t[:1])
    rows, flat = len(t), y.reshape(len(t), -1)
    state = made.start(y[0], float(t[0]), numbers)
    _, n_x, n_info = made.sizes
    x, info, block = np.empty((rows, n_x)), np.empty((rows, len(form.kept))), np.empty((min(rows, BLOCK), n_info))
    for at in range(0, rows, BLOCK):
        part = slice(at, at + BLOCK)
        count = len(dt[part])
        arrays = (acting[part], flat[part], dt[part], x[part], block)
        made.library.kernel_run(made.pointer(numbers), made.pointer(state), count, *map(made.pointer, arrays))
        info[part] = block[:count, form.kept]
    told = form.told(info)
    if told.result is not None and told.result[0] == Result.REPEATED:
        told.result[0] = Result.OK  # the first row is no step
    return Run(jnp.asarray(t), form.estimate(x), told)


def _split(kinds: Any) -> Callable[[np.ndarray], Any]:
    """What makes columns of an array the leaves of a pytree."""
    leaves, tree = jax.tree.flatten(kinds)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]

    def split(rows: np.ndarray) -> Any:
        parts = zip(np.split(rows, ends, axis=1), leaves, strict=True)
        return jax.tree.unflatten(tree, [p.reshape(len(rows), *leaf.shape).astype(leaf.dtype) for p, leaf in parts])

    return split
