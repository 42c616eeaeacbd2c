"""Whole logs through an observer by compiled C, where it pays."""

import itertools
import os
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant._compile import vector_bytes
from covariant.engine._compile import missing
from covariant.engine._kernel import Kernel, kernel, outlasts
from covariant.lowering import LoweringError
from covariant.observers import AbstractObserver, checked, run
from covariant.signals import Record, Result, Run

EngineName = Literal["auto", "c", "jax"]
FEWEST_ROWS = 100_000
"""Fewest rows, of all logs together, for which C is worth its compilation although nothing is kept of it."""
RUNS_A_CORE = 4
"""More runs than this for each core go through lanes: a step in all lanes takes about as long as four of one run."""
WRITTEN_IN = {"model", "metric"}
"""Fields of observers whose numbers are written into the code, where zeros and ones save work; gains are arguments."""
MOST_OPEN = 100
"""Numbers of the largest array that is an argument, the covariance of ten joints: tables of numbers are written in."""


def run_log(
    observer: AbstractObserver, record: Record, keep: Collection[str] | None = None, engine: EngineName = "auto"
) -> tuple[Run, str]:
    """As `observers.run`, by C where it pays, and the engine that did it: "c", or "jax" with the reason.

    - `engine`: "auto" uses C where the compiled observer is kept for later processes, and for a log of `FEWEST_ROWS`
      rows; "c" uses it for any, and "jax" never.

    The results are those of JAX up to rounding. JAX does the work where there is no compiler, and where the observer
    has no graph. Raises `ValueError` as `observers.run` does, and for an unknown engine.
    """
    (done,), name = run_logs(observer, record, keep, engine)
    return done, name


def run_logs(
    observers: AbstractObserver | Sequence[AbstractObserver],
    records: Record | Sequence[Record],
    keep: Collection[str] | None = None,
    engine: EngineName = "auto",
    others: Sequence[AbstractObserver] = (),
) -> tuple[list[Run], str]:
    """Many runs: one observer over many logs, many observers over one log, or as many observers as logs in pairs.

    - `observers`: of one kind, told apart by their numbers, such as gains or masses; all are one compiled program, and
      so are observers of other calls and processes that have other gains or covariances.
    - `records`: logs of any lengths, with measurements and inputs of one shape.
    - `keep`, `engine`: as for `run_log`; the rows of all logs count together. C uses every core.
    - `others`: observers of other calls: numbers of models that tell any of them apart stay open in the compiled
      program too, so that a search for the best ones compiles one.

    Returns the runs in order, and the engine that made them. Raises `ValueError` as `observers.run` does, for counts
    that do not fit, and for observers or records of different forms.
    """
    if engine not in get_args(EngineName):
        raise ValueError(f"engine must be one of {', '.join(get_args(EngineName))}; got {engine!r}")
    many = [observers] if isinstance(observers, AbstractObserver) else list(observers)
    logs = [records] if isinstance(records, Record) else list(records)
    if not many or not logs or (1 not in (len(many), len(logs)) and len(many) != len(logs)):
        raise ValueError(
            f"run_logs needs one observer, one record, or as many of both; got {len(many)} observers "
            f"and {len(logs)} records"
        )
    for record in logs:
        checked(many[0], record)
    forms = {(np.shape(r.y)[1:], np.shape(r.u)[1]) for r in logs}
    if len(forms) > 1:
        told = ", ".join(f"y {y} and {u} inputs" for y, u in sorted(forms, key=str))
        raise ValueError(f"run_logs: measurements and inputs must have one shape in all records; got {told}")
    count = max(len(many), len(logs))
    opened, numbers = _open([*many, *others])
    each, logs = many * (count // len(many)), logs * (count // len(logs))
    rows = sum(len(r.t) for r in logs)
    why = "as asked" if engine == "jax" else missing()
    if why is None and engine == "auto" and rows < FEWEST_ROWS:
        # C computes in double precision: the type of a result must not depend on what is kept.
        if any(np.result_type(log.y) != np.float64 for log in logs):
            why = f"fewer than {FEWEST_ROWS} rows, in single precision"
        elif not outlasts(many[0], np.asarray(logs[0].y[0]), np.shape(logs[0].u)[1], opened):
            why = f"fewer than {FEWEST_ROWS} rows, and compiled C would not be kept"
    if why is None:
        try:
            return _by_c(each, opened, np.resize(numbers[: len(many)], (count, numbers.shape[1])), logs, keep), "c"
        except (LoweringError, OSError) as error:
            why = f"{error}"
    return [run(observer, record, keep) for observer, record in zip(each, logs, strict=True)], f"jax: {why}"


def _open(observers: Sequence[AbstractObserver]) -> tuple[tuple[int, ...], np.ndarray]:
    """Which arrays of observers are no part of the code, and their numbers, a row for each observer.

    Raises `ValueError` where the observers differ in more than the values of their arrays.
    """
    leaves, trees = zip(*map(jax.tree.flatten, observers), strict=True)
    real = [eqx.is_inexact_array(leaf) for leaf in leaves[0]]
    for k, (tree, own) in enumerate(zip(trees, leaves, strict=True)):
        if tree != trees[0] or not all(map(_alike, real, own, leaves[0])):
            raise ValueError(
                f"run_logs: observer {k} is of another kind than the first, not only of other numbers; run it alone"
            )
    paths = [path for path, _ in jax.tree_util.tree_flatten_with_path(observers[0])[0]]
    arrays = [i for i, is_real in enumerate(real) if is_real]
    columns = [np.stack([np.ravel(own[i]) for own in leaves]).astype(float) for i in arrays]
    gains = [_is_gain(paths[i]) and column.shape[1] <= MOST_OPEN for i, column in zip(arrays, columns, strict=True)]
    opened = tuple(k for k, column in enumerate(columns) if gains[k] or (column != column[0]).any())
    return opened, np.concatenate([np.empty((len(observers), 0)), *(columns[k] for k in opened)], axis=1)


def _is_gain(path: Sequence[Any]) -> bool:
    return WRITTEN_IN.isdisjoint(getattr(key, "name", None) for key in path)


def _alike(real: bool, leaf: Any, first: Any) -> bool:
    """Whether leaves of two observers differ at most in the values of an array of real numbers."""
    if leaf is first:
        return True
    if real:
        return eqx.is_inexact_array(leaf) and np.shape(leaf) == np.shape(first)
    return not eqx.is_inexact_array(leaf) and bool(eqx.tree_equal(leaf, first))


def _by_c(
    observers: Sequence[AbstractObserver],
    opened: tuple[int, ...],
    numbers: np.ndarray,
    logs: Sequence[Record],
    keep: Collection[str] | None,
) -> list[Run]:
    cores = os.cpu_count() or 1
    lanes = vector_bytes() // np.dtype(float).itemsize if len(logs) > RUNS_A_CORE * cores else 1
    made = kernel(observers[0], np.asarray(logs[0].y[0]), np.shape(logs[0].u)[1], opened, lanes)
    form = _Form.of(made, keep)
    # Runs of like lengths go together, since lanes wait for the longest.
    order = sorted(range(len(logs)), key=lambda k: len(logs[k].t))
    blocks = [order[k : k + lanes] for k in range(0, len(order), lanes)]
    read = {id(log): _Columns.of(log) for log in logs}
    with ThreadPoolExecutor(min(len(blocks), cores)) as pool:  # C lets go of Python's lock while it runs
        found = pool.map(lambda block: _through(made, form, numbers[block], [read[id(logs[k])] for k in block]), blocks)
        runs = dict(zip(order, itertools.chain(*found), strict=True))
    return [runs[k] for k in range(len(logs))]


class _Form(NamedTuple):
    """How columns of numbers become a run.

    - `kept`: the columns of an info that are kept; `estimate`, `told`: `(T, columns) -> pytree`.
    """

    kept: np.ndarray
    estimate: Callable[[np.ndarray], Any]
    told: Callable[[np.ndarray], Any]

    @classmethod
    def of(cls, made: Kernel, keep: Collection[str] | None) -> "_Form":
        """The form of the runs of an observer."""
        paths, _ = jax.tree_util.tree_flatten_with_path(made.text.info)
        names = [path[0].name for path, leaf in paths for _ in range(leaf.size)]
        kept = np.flatnonzero([keep is None or name in keep for name in names])
        dropped = () if keep is None else set(made.text.info._fields) - set(keep)
        return cls(kept, _split(made.text.estimate), _split(made.text.info._replace(**dict.fromkeys(dropped))))


class _Columns(NamedTuple):
    """A log as C reads it: stamps, and input, measurement and time step of each row."""

    t: jax.Array
    start: float
    u: np.ndarray
    y: np.ndarray
    dt: np.ndarray

    @classmethod
    def of(cls, record: Record) -> "_Columns":
        """The columns of a log."""
        t, u, y = (np.ascontiguousarray(a, float) for a in record[:3])
        acting = np.concatenate([u[:1], u[:-1]])  # the input that acted since the previous stamp
        return cls(jnp.asarray(t), float(t[0]), acting, y.reshape(len(t), -1), np.diff(t, prepend=t[:1]))


def _through(made: Kernel, form: _Form, numbers: np.ndarray, logs: Sequence[_Columns]) -> list[Run]:
    """Logs through a kernel, as many as it has lanes or fewer, with the open numbers of each."""
    kept = form.kept.tolist()
    found = [(np.empty((len(log.y), made.sizes[1])), np.empty((len(log.y), len(kept)))) for log in logs]
    lanes = np.minimum(np.arange(made.lanes), len(logs) - 1).tolist()  # those left over do the last log as well
    opened = np.ascontiguousarray(numbers[lanes].T)
    first, t = np.stack([logs[k].y[0] for k in lanes], axis=1), np.array([logs[k].start for k in lanes])
    state = np.empty((made.sizes[0], made.lanes))
    made.library.kernel_init(*map(made.pointer, (opened, first, t, state)))
    made.library.kernel_run(
        made.pointer(opened),
        made.pointer(state),
        made.ffi.new("long[]", [len(logs[k].y) for k in lanes]),
        made.pointers([a for k in lanes for a in logs[k][2:]]),
        made.ffi.new("int[]", kept),
        len(kept),
        made.pointers([a for k in lanes for a in found[k]]),
    )
    return [_run(form, log.t, x, info) for log, (x, info) in zip(logs, found, strict=True)]


def _run(form: _Form, t: jax.Array, x: np.ndarray, info: np.ndarray) -> Run:
    told = form.told(info)
    if told.result is not None and told.result[0] == Result.REPEATED:
        told.result[0] = Result.OK  # the first row is no step
    return Run(t, form.estimate(x), told)


def _split(kinds: Any) -> Callable[[np.ndarray], Any]:
    """What makes columns of an array the leaves of a pytree."""
    leaves, tree = jax.tree.flatten(kinds)
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]

    def split(rows: np.ndarray) -> Any:
        parts = zip(np.split(rows, ends, axis=1), leaves, strict=True)
        return jax.tree.unflatten(tree, [p.reshape(len(rows), *leaf.shape).astype(leaf.dtype) for p, leaf in parts])

    return split
