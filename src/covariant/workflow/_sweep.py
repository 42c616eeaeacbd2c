"""`sweep`: very many short runs of observers, over starts, noise, gains, rates and errors of the model."""

import functools
import itertools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant import engine, models
from covariant._names import unknown
from covariant.metrics import Variable, map_grid, open_grid
from covariant.workflow._arguments import Scheduler
from covariant.workflow._design import design
from covariant.workflow._outputs import check_output, write_table
from covariant.workflow._pages import write_result_page
from covariant.workflow._progress import Progress, notebook_line
from covariant.workflow._result import AbstractTable
from covariant.workflow._simulated_log import DETUNED
from covariant.workflow._study import Study, parse_study, read_study

SETTLED = 0.8
"""Part of a run after which errors count."""
FINE = 4
"""Steps of the integration of the truth in an interval of the samples."""


def sweep(
    study: str | Path,
    store: str | Path,
    *,
    workers: int | None = None,
    scheduler: Scheduler | None = None,
    progress: Progress = notebook_line,
) -> "SweepResult":
    """Run observers over a table of cases: starts, noise, gains, rates and errors of the model.

    A study is a small TOML file. Its table [axes] has what varies: `"start.q1"` and other initial positions and
    velocities of the machine, `noise` of its positions, the `rate` of the samples, `draw`, a number of random draws,
    and any key of the model file, such as `"parameters.mass"` or `"uncertainty.acceleration"`, which the observers are
    designed with and the machine is not. All combinations are run, by compiled C. A run that was stopped goes on when
    it is called again.

    Use it for basins of attraction, for the consistency of a filter, and for what a gain costs at another rate.

    Args:
        study: The file of the study (.toml).
        store: The store to write, or to go on with (.zarr).
        workers: Threads; as many as processors by default.
        scheduler: Address of a Dask scheduler, or a `distributed.Client`, whose workers compute.
        progress: Called with a description and the fraction of the runs that are done.

    Returns:
        For each observer and each combination of what varies but starts and draws: how many runs end near the truth,
        median error, and mean NEES of those.

    Raises:
        ValueError: For a study that makes no sense, or a store of another one.

    Example:
        >>> from pathlib import Path
        >>> from covariant import workflow
        >>> text = 'model = "oscillator"\\nobservers = ["intrinsic"]\\nrate = 50.0\\nduration = 2.0\\nbelow = 0.05'
        >>> axes = '[set]\\n"measurement.std" = 1e-3\\n"uncertainty.acceleration" = 1.0\\n[axes]\\n'
        >>> axes += '"start.v1" = {low = -2.0, high = 2.0, count = 9}'
        >>> _ = Path("basin.toml").write_text(f"{text}\\n{axes}")
        >>> workflow.sweep("basin.toml", "basin.zarr").columns["converged"].tolist()
        [1.0]
    """
    out, path = Path(store), Path(study)
    check_output(out, ".zarr", store=True)
    plan = read_study(path)
    progress(f"designing {', '.join(plan.observers)}")
    runs = _Runs(plan.text)
    result = runs.variables()

    def report(done: int, total: int) -> None:
        progress(f"{path.name}: {done} of {total} cases", done / total)

    try:
        map_grid(
            runs,
            plan.grid,
            out,
            variables=result,
            provenance={"study": json.loads(plan.text)},
            workers=workers,
            scheduler=scheduler,
            on_progress=report,
        )
    except KeyboardInterrupt as stopped:
        raise KeyboardInterrupt("stopped; the same command goes on where it stopped") from stopped
    return SweepResult(path, out, plan)


@dataclass(frozen=True)
class _Runs:
    """The function of a case: a text, so that a worker of a cluster compiles it for itself."""

    text: str

    def __call__(self, x: Any) -> dict[str, Any]:
        return _compiled(self.text).run(x)

    def variables(self) -> dict[str, Variable]:
        """What a run gives for each observer."""
        made = _compiled(self.text)
        result = {}
        for name, family in made.families.items():
            result[f"{_plain(name)}_error"] = Variable((), "1", f"root mean square of the velocity errors of {name}")
            if family.tells_std:
                result[f"{_plain(name)}_nees"] = Variable((), "1", f"mean NEES of {name} for each velocity")
        return result


def _plain(name: str) -> str:
    return name.replace("-", "_")


class _Family(NamedTuple):
    """Observers of one name for all designs: a compiled step, and the numbers in which they differ."""

    step: Callable[..., Any]
    init: Callable[..., Any]
    numbers: list[Any]
    tells_std: bool


class _Machine(NamedTuple):
    """The truth, and observers of it, for any case."""

    plan: Study
    model: Any
    start: Any
    names: tuple[str, ...]
    inputs: int
    intervals: Any
    counts: Any
    families: dict[str, _Family]

    def run(self, x: Any) -> dict[str, Any]:
        """Errors of all observers in a case."""
        content, n = self.plan.content, len(self.names) // 2
        place, noise, draw, start = jnp.zeros((), int), jnp.asarray(content.get("noise", 0.0), float), 0, {}
        for axis, at in zip(self.plan.axes, x, strict=True):
            if axis.designs:
                place = place * len(axis.values) + jnp.round(at).astype(int)
            elif axis.key == "noise":
                noise = axis.at(at)
            elif axis.key == "draw":
                draw = jnp.round(at).astype(int)
            else:
                start[axis.key.removeprefix("start.")] = axis.at(at)
        both = self.start
        for name, value in start.items():
            both = both.at[self.names.index(name)].set(value)
        noisy = bool(content.get("noise")) or "noise" in content["axes"]
        key = jax.random.fold_in(jax.random.key(content.get("seed", 0)), draw)
        h, count = self.intervals[place], self.counts[place]
        amplitude = np.broadcast_to(np.asarray(content.get("amplitude", 0.0), float), (self.inputs,))
        omega = 2 * np.pi * content.get("frequency", 0.5) * (1 + DETUNED * np.arange(self.inputs))
        late = jnp.floor(SETTLED * count.astype(float)).astype(int)
        counted = (count - late).astype(float)
        result = {}
        for name, family in self.families.items():
            numbers = [leaf[place] for leaf in family.numbers]

            def sample(k, key=key):
                return noise * jax.random.normal(jax.random.fold_in(key, k), (n,)) if noisy else jnp.zeros(n)

            def body(k, carry, family=family, numbers=numbers, sample=sample):
                q, v, state, squares, nees = carry
                u = jnp.asarray(amplitude) * jnp.sin(jnp.asarray(omega) * (k.astype(float) * h))
                q, v, state, off, ratio = family.step(numbers, k * h, q, v, state, u, sample(k + 1), h)
                last = k >= late
                return q, v, state, squares + jnp.where(last, off, 0.0), nees + jnp.where(last, ratio, 0.0)

            q, v = self.model.manifold.retract(self.model.manifold.origin(), both[:n]), both[n:]
            state = family.init(numbers, self.model.manifold.ambient.retract(q, sample(0)))
            *_, squares, nees = jax.lax.fori_loop(0, count, body, (q, v, state, jnp.zeros(()), jnp.zeros(())))
            result[f"{_plain(name)}_error"] = jnp.sqrt(squares / counted)
            if family.tells_std:
                result[f"{_plain(name)}_nees"] = nees / counted / n
        return result


@functools.lru_cache(maxsize=4)
def _compiled(text: str) -> _Machine:
    """Machine and observers of a study, compiled once in each process."""
    plan = parse_study(json.loads(text))
    content = plan.content
    overrides = content.get("set", {})
    file = models.load(plan.model, overrides)
    model: Any = file.need_mechanical(plan.model, "a sweep simulates")
    if model.feet is not None:
        raise ValueError(f"{plan.model}: a sweep simulates no contacts; take a model without feet")
    n, inputs = file.dimension, models.input_count(model, file.dimension)
    names = (*(f"q{k + 1}" for k in range(n)), *(f"v{k + 1}" for k in range(n)))
    states = {**content.get("start", {}), **{a.key[6:]: 0.0 for a in plan.axes if a.key.startswith("start.")}}
    for name in states:
        if name not in names:
            raise ValueError(f"start: {unknown('state', name, names)}")
    both = jnp.array([float(states.get(name, 0.0)) for name in names])
    rates = np.array([float({**content, **each}["rate"]) for each in plan.designs])
    files = [
        models.load(plan.model, overrides | {k: v for k, v in each.items() if k != "rate"}) for each in plan.designs
    ]
    families = {
        name: _family(
            model,
            [design(each, name, rate=rate).observer for each, rate in zip(files, rates, strict=True)],
            inputs,
        )
        for name in plan.observers
    }
    counts = jnp.asarray(np.maximum(np.round(content["duration"] * rates), 2).astype(int))
    return _Machine(plan, model, both, names, inputs, jnp.asarray(1 / rates), counts, families)


def _family(model: Any, observers: Sequence[Any], inputs: int) -> _Family:
    leaves, trees = zip(*map(jax.tree.flatten, observers), strict=True)
    differ = [
        k
        for k, column in enumerate(zip(*leaves, strict=True))
        if not all(map(_same, column, leaves[0][k : k + 1] * len(leaves)))
    ]
    if any(tree != trees[0] for tree in trees):
        raise ValueError("designs of one observer differ in more than numbers; sweep them one by one")
    numbers = [jnp.stack([jnp.asarray(each[k], float) for each in leaves]) for k in differ]

    def observer(values: Sequence[Any]) -> Any:
        changed = list(leaves[0])
        for k, value in zip(differ, values, strict=True):
            changed[k] = value
        return jax.tree.unflatten(trees[0], changed)

    origin = model.manifold.origin()
    kinds = jax.eval_shape(observers[0].init, origin)

    def as_numbers(state: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf.astype(float), state)

    def init(values: Sequence[Any], y: Any) -> Any:
        return as_numbers(observer(values).init(y))

    def step(values: Any, t: Any, q: Any, v: Any, state: Any, u: Any, noise: Any, h: Any) -> Any:
        each = observer(values)
        motion = models.advance(model, t, models.Motion(q, v), u, h, FINE)
        state = jax.tree.map(lambda leaf, kind: leaf.astype(kind.dtype), state, kinds)
        state, info = each.step(state, u, model.manifold.ambient.retract(motion.q, noise), h)
        off = model.sought.of(each.estimate(state)) - motion.v
        std = getattr(info, "velocity_std", None)
        nees = jnp.zeros(()) if std is None else jnp.sum((off / std) ** 2)
        return motion.q, motion.v, as_numbers(state), jnp.sum(off**2), nees

    first = [leaf[0] for leaf in numbers]
    zero, state = model.manifold.zero(origin), jax.eval_shape(init, first, origin)
    compiled = engine.compiled(step, first, jnp.zeros(()), origin, zero, state, jnp.zeros(inputs), zero, jnp.zeros(()))
    _, info = jax.eval_shape(lambda q: observers[0].step(observers[0].init(q), jnp.zeros(inputs), q, 0.01), origin)
    return _Family(compiled, init, numbers, getattr(info, "velocity_std", None) is not None)


def _same(leaf: Any, first: Any) -> bool:
    return leaf is first or bool(np.array_equal(np.asarray(leaf), np.asarray(first)))


@dataclass(frozen=True, repr=False)
class SweepResult(AbstractTable):
    """A finished sweep: a row for each observer and each combination of what varies but starts and draws.

    Attributes:
        study: The file of the study.
        store: The Zarr store with the results of all runs.
        plan: The study.

    Example:
        >>> from pathlib import Path
        >>> from covariant import workflow
        >>> text = 'model = "oscillator"\\nobservers = ["intrinsic"]\\nrate = 50.0\\nduration = 2.0\\n'
        >>> axes = '[set]\\n"measurement.std" = 1e-3\\n"uncertainty.acceleration" = 1.0\\n[axes]\\n"start.v1" = [-1, 1]'
        >>> _ = Path("two.toml").write_text(text + axes)
        >>> workflow.sweep("two.toml", "two.zarr")
        <SweepResult: 2 runs of intrinsic>
    """

    study: Path
    store: Path
    plan: Study

    @property
    def columns(self) -> dict[str, np.ndarray]:
        return self._columns

    @functools.cached_property
    def _columns(self) -> dict[str, np.ndarray]:
        stored = open_grid(self.store, complete=True)
        inner = [axis.name for axis in self.plan.axes if axis.key.startswith("start.") or axis.key == "draw"]
        outer = [axis for axis in self.plan.axes if axis.name not in inner]
        below = self.plan.content.get("below", math.inf)
        rows = []
        for name in self.plan.observers:
            error: Any = stored[f"{_plain(name)}_error"]
            finite: Any = error.notnull() & (abs(error) < math.inf)
            count = float(np.prod([stored.sizes[each] for each in inner]))
            parts = {
                "converged": ((error < below) & finite).sum(inner) / count,
                "not finite": (~finite).sum(inner) / count,
                # A quantile over chunks of a large store is one pass over each, in their order.
                "median error": error.chunk(dict.fromkeys(inner, -1)).quantile(0.5, inner) if inner else error,
            }
            if f"{_plain(name)}_nees" in stored:
                # A run that diverged would decide the mean alone.
                parts["NEES"] = stored[f"{_plain(name)}_nees"].where(finite & (error < below)).mean(inner)
            values = {key: np.asarray(part).ravel() for key, part in parts.items()}
            for k, each in enumerate(itertools.product(*(axis.values for axis in outer))):
                varied = {
                    a.key: str(value) if isinstance(value, list) else value
                    for a, value in zip(outer, each, strict=True)
                }
                rows.append({"observer": name, **varied, **{key: float(part[k]) for key, part in values.items()}})
        names = dict.fromkeys(key for row in rows for key in row)
        return {
            key: np.array(
                [row.get(key, math.nan) for row in rows], object if isinstance(rows[0].get(key), str) else None
            )
            for key in names
        }

    @property
    def runs(self) -> int:
        """Number of runs of all observers."""
        return self.plan.grid.size * len(self.plan.observers)

    @property
    def _rows(self) -> list[dict[str, Any]]:
        return [
            dict(zip(self.columns, row, strict=True))
            for row in zip(*(c.tolist() for c in self.columns.values()), strict=True)
        ]

    @property
    def summary(self) -> dict[str, Any]:
        return {"study": str(self.study), "out": str(self.store), "runs": self.runs, "rows": self._rows}

    @property
    def headline(self) -> str:
        return f"{self.runs} runs of {', '.join(self.plan.observers)}"

    written = (".csv",)

    def _write(self, path: Path) -> None:
        write_table(path, self.columns)

    @property
    def _blocks(self) -> list[Any]:
        return [self._rows]

    def _write_page(self, path: Path) -> list[Path]:
        return write_result_page(path, f"Sweep {self.study.stem}", self, self._blocks, {"study": str(self.study)})

    def __str__(self) -> str:
        def text(value: Any) -> str:
            return f"{value:.4g}" if isinstance(value, float) else str(value)

        names = list(self.columns)
        lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
        lines += [f"| {' | '.join(map(text, row.values()))} |" for row in self._rows]
        return "\n".join([f"wrote {self.store}: {self.headline}", "", *lines])
