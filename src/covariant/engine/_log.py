"""Runs observers over whole logs, by compiled C if it pays."""

import itertools
import os
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from covariant.engine._choice import EngineName, choose_open
from covariant.engine._kernel import Kernel, KernelForm
from covariant.observers import AbstractObserver, checked, run
from covariant.signals import Record, Run, StepCode
from scalargraph.compiler import vector_bytes
from scalargraph.errors import InputError

RUNS_A_CORE = 4
"""Runs per core above which lanes are used: a step in all lanes takes about as long as four steps of single runs."""


def run_log(
    observer: AbstractObserver, record: Record, keep: Collection[str] | None = None, engine: EngineName = "auto"
) -> tuple[Run, str]:
    """Run an observer over a log, as `observers.run` does, by compiled C if it pays.

    Use it for long logs and repeated runs. "auto" compiles only if the log is long enough to pay, or if the compiled
    observer can be cached; the second result says which engine ran and why. It cannot be used under `jit` or for
    derivatives; use `observers.run` for these.

    Args:
        observer: Any observer.
        record: The log: stamps (T,) [s], inputs (T, m), measurements (T, n) or (T, N, N), converted to double
            precision.
        keep: Names of the fields of the info that are recorded; by default all.
        engine: "auto", "c" or "jax"; see `choose` for the rule.

    Returns:
        A `Run` of NumPy arrays, the same for all engines up to rounding, and the engine: "c", or "jax: " with the
            reason.

    Raises:
        ValueError: As from `observers.run`, or the engine is unknown.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers, signals
        >>> from covariant.engine import run_log
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> log = signals.Record(t, np.zeros((101, 2)), np.zeros((101, 2)))
        >>> observer = observers.Intrinsic(models.pendulum_chain(), 10.0, 100.0)
        >>> run, engine = run_log(observer, log, engine="jax")
        >>> run.estimate.shape, engine
        ((101, 4), 'jax: as asked')
    """
    (done,), name = run_logs(observer, record, keep, engine)
    return done, name


def run_logs(
    observers: AbstractObserver | Sequence[AbstractObserver],
    records: Record | Sequence[Record],
    keep: Collection[str] | None = None,
    engine: EngineName = "auto",
    others: Sequence[AbstractObserver] = (),
    repeats: int = 1,
) -> tuple[list[Run], str]:
    """Run observers over logs: one over many logs, many over one log, or pairs of an observer and a log.

    Use it for searches and Monte Carlo studies: one program is compiled for all, and C runs them on every core.
    Observers may differ only in their numbers, not in kind or shape. For a single run use `run_log`.

    Args:
        observers: Observers of one kind that differ in their numbers, such as gains or masses. All share one compiled
            program, also with observers of other calls and processes.
        records: Logs of any lengths, with measurements and inputs of one shape.
        keep: As for `run_log`.
        engine: As for `run_log`; the rows of all logs count together. C uses every core.
        others: Observers of other calls. Numbers that differ in any of them become arguments of the compiled program
            too, even zeros, so that a search over observers compiles a single program.
        repeats: Number of similar calls to come; their rows count too.

    Returns:
        The runs in order, and the engine that computed them.

    Raises:
        ValueError: As from `observers.run`; or the counts do not match, or observers or records have different forms.

    Example:
        >>> import numpy as np
        >>> from covariant import engine, observers, signals
        >>> t = np.linspace(0.0, 1.0, 11)
        >>> logs = [signals.Record(t, y=np.outer(t, [speed])) for speed in (1.0, 2.0)]
        >>> runs, name = engine.run_logs(observers.FilteredDerivative(50.0), logs, engine="jax")
        >>> [round(float(run.estimate[-1, 1]), 1) for run in runs], name
        ([1.0, 2.0], 'jax: as asked')
    """
    many = [observers] if isinstance(observers, AbstractObserver) else list(observers)
    logs = [records] if isinstance(records, Record) else list(records)
    if not many or not logs or (1 not in (len(many), len(logs)) and len(many) != len(logs)):
        raise InputError(
            f"run_logs needs one observer, one record, or as many of both; got {len(many)} observers "
            f"and {len(logs)} records"
        )
    logs = [_in_double(checked(many[0], record)) for record in logs]
    forms = {(r.y.shape[1:], r.u.shape[1]) for r in logs}
    if len(forms) > 1:
        shapes = ", ".join(f"y {y} and {u} inputs" for y, u in sorted(forms, key=str))
        raise InputError(f"run_logs: measurements and inputs must have one shape in all records; got {shapes}")
    count = max(len(many), len(logs))
    each, logs = many * (count // len(many)), logs * (count // len(logs))
    # With fewer runs, some cores would be idle while others compute lanes.
    lanes = vector_bytes() // np.dtype(float).itemsize if count > RUNS_A_CORE * (os.cpu_count() or 1) else 1
    ((y, inputs),) = forms
    rows = repeats * sum(len(r.t) for r in logs)
    real = not any(np.iscomplexobj(r.y) for r in logs)
    chosen, numbers = choose_open([*many, *others], KernelForm(y, inputs, (), lanes, real), rows, engine)
    if chosen.kernel is not None:
        # np.resize repeats the rows, for one observer over many logs.
        opened = np.resize(numbers[: len(many)], (count, numbers.shape[1]))
        runs = _by_c(chosen.kernel, opened, logs, keep, many[0].input_at_end)
    else:
        runs = [_by_jax(observer, record, keep) for observer, record in zip(each, logs, strict=True)]
    return runs, str(chosen)


def _in_double(record: Record) -> Record:
    """Stamps, inputs and measurements in double precision, so that all engines return the same types."""
    return Record(*(np.asarray(a, np.result_type(a, float)) for a in record[:3]))


def _by_jax(observer: AbstractObserver, record: Record, keep: Collection[str] | None) -> Run:
    # The results are copied, since NumPy cannot write to JAX's arrays, unlike to those from C.
    return jax.tree.map(np.array, run(observer, record, keep))


def _by_c(
    kernel: Kernel, numbers: np.ndarray, logs: Sequence[Record], keep: Collection[str] | None, input_at_end: bool
) -> list[Run]:
    cores, lanes = os.cpu_count() or 1, kernel.lanes
    form = _Columns.of(kernel, keep)
    # Runs of similar lengths are grouped, since lanes wait for the longest run.
    order = sorted(range(len(logs)), key=lambda k: len(logs[k].t))
    blocks = [order[k : k + lanes] for k in range(0, len(order), lanes)]
    # Identity is the key, so that a log used in many runs is converted once.
    rows = {id(log): _Rows.of(log, input_at_end) for log in logs}

    def through(block: list[int]) -> list[Run]:
        return _through(kernel, form, numbers[block], [rows[id(logs[k])] for k in block])

    with ThreadPoolExecutor(min(len(blocks), cores)) as pool:  # C releases Python's global lock while it runs
        results = pool.map(through, blocks)
        runs = dict(zip(order, itertools.chain(*results), strict=True))
    return [runs[k] for k in range(len(logs))]


class _Columns(NamedTuple):
    """Converts columns of numbers to a run.

    - `kept`: indices of the columns of an info that are recorded.
    - `estimate`, `told`: `(T, columns) -> pytree`, converters of estimates and of infos.
    """

    kept: np.ndarray
    estimate: Callable[[np.ndarray], Any]
    told: Callable[[np.ndarray], Any]

    @classmethod
    def of(cls, made: Kernel, keep: Collection[str] | None) -> "_Columns":
        """Columns of the runs of a kernel, with the fields `keep` of the info."""
        paths, _ = jax.tree_util.tree_flatten_with_path(made.layout.info)
        names = [path[0].name for path, leaf in paths for _ in range(leaf.size)]
        kept = np.flatnonzero([keep is None or name in keep for name in names])
        dropped = () if keep is None else set(made.layout.info._fields) - set(keep)
        return cls(
            kept,
            _make_splitter(made.layout.estimate),
            _make_splitter(made.layout.info._replace(**dict.fromkeys(dropped))),
        )


class _Rows(NamedTuple):
    """A log in the form that C reads: stamps, and input, measurement and time step of each row."""

    t: np.ndarray
    start: float
    u: np.ndarray
    y: np.ndarray
    dt: np.ndarray

    @classmethod
    def of(cls, record: Record, input_at_end: bool) -> "_Rows":
        """Rows of a log as contiguous arrays."""
        t, u, y = map(np.ascontiguousarray, record[:3])
        # By default, a row uses the input that acted since the previous stamp.
        acting = u if input_at_end else np.concatenate([u[:1], u[:-1]])
        # The first dt is 0: a step of zero length gives the estimate at rest as the first row; see `_make_run`.
        return cls(t.copy(), float(t[0]), acting, y.reshape(len(t), -1), np.diff(t, prepend=t[:1]))


def _through(kernel: Kernel, form: _Columns, numbers: np.ndarray, logs: Sequence[_Rows]) -> list[Run]:
    """Run logs through a kernel, at most one for each lane, with the open numbers of each."""
    columns = form.kept.tolist()
    outputs = [(np.empty((len(log.y), kernel.sizes[1])), np.empty((len(log.y), len(columns)))) for log in logs]
    lanes = np.minimum(np.arange(kernel.lanes), len(logs) - 1).tolist()  # unused lanes repeat the last log
    opened = np.ascontiguousarray(numbers[lanes].T)
    first, t = np.stack([logs[k].y[0] for k in lanes], axis=1), np.array([logs[k].start for k in lanes])
    state = np.empty((kernel.sizes[0], kernel.lanes))
    kernel.library.kernel_init(*map(kernel.pointer, (opened, first, t, state)))
    kernel.library.kernel_run(
        kernel.pointer(opened),
        kernel.pointer(state),
        kernel.ffi.new("long[]", [len(logs[k].y) for k in lanes]),
        kernel.pointers([a for k in lanes for a in logs[k][2:]]),
        kernel.ffi.new("int[]", columns),
        len(columns),
        kernel.pointers([a for k in lanes for a in outputs[k]]),
    )
    return [_make_run(form, log.t, x, info) for log, (x, info) in zip(logs, outputs, strict=True)]


def _make_run(form: _Columns, t: np.ndarray, x: np.ndarray, info: np.ndarray) -> Run:
    infos = form.told(info)
    if infos.result is not None and infos.result[0] == StepCode.REPEATED:
        infos.result[0] = StepCode.OK  # the first row is not a step
    return Run(t, form.estimate(x), infos)


def _make_splitter(kinds: object) -> Callable[[np.ndarray], Any]:
    """A function that splits the columns of an array into the leaves of a pytree."""
    leaves, tree = jax.tree.flatten(kinds)
    ends = np.cumsum([leaf.size for leaf in leaves], dtype=int)

    def split(rows: np.ndarray) -> Any:
        parts = [
            rows[:, end - leaf.size : end].reshape(len(rows), *leaf.shape).astype(leaf.dtype)
            for end, leaf in zip(ends, leaves, strict=True)
        ]
        return jax.tree.unflatten(tree, parts)

    return split
