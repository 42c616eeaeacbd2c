"""Runs observers in very many short simulations, over starts, noise, gains, rates and errors of the model."""

import functools
import itertools
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from covariant.many._study import Axis, Study, read_study
from covariant.many._sweep_runs import Runs, plain
from covariant.metrics import map_grid, open_grid
from covariant.verbs.base.arguments import Scheduler
from covariant.verbs.base.model_output import code_hash, model_hash
from covariant.verbs.base.outputs import check_output, write_table
from covariant.verbs.base.pages import write_result_page
from covariant.verbs.base.progress import Progress, notebook_line, time_left
from covariant.verbs.base.result import AbstractTable
from scalargraph.errors import InputError

HEADINGS = {"nees": "NEES", "nis": "NIS", "band": "in band"}
"""Headings of columns with means over the runs that converged."""


def sweep(
    study: str | Path,
    store: str | Path,
    *,
    workers: int | None = None,
    scheduler: Scheduler | None = None,
    progress: Progress = notebook_line,
) -> "SweepResult":
    """Run observers over a table of cases: starts, noise, gains, rates and errors of the model.

    A study is a small TOML file. Its table [axes] contains the axes along which runs vary: `"start.q1"` and other
    initial positions and velocities of the machine, `"error.q1"` and other initial errors of the observers, `noise` of
    its positions, random `acceleration` of the machine, the `rate` of the samples, `draw` (a number of random draws),
    and any key of the model file, such as `"parameters.mass"` or `"uncertainty.acceleration"`. Such a key varies only
    in the model of the observers, not in the machine. Several keys may vary together, as lists by key. All combinations
    are run, by compiled C if there is a compiler. A stopped run continues when it is called again.

    The observers are those that the model file yields without a log. `estimate` takes the usual speed of each
    coordinate from the log if it is larger than `uncertainty.motion_acceleration` times `uncertainty.motion_time`; give
    these two keys in the table [set] to design for that speed here.

    Use it for basins of attraction, for the consistency of a filter, and for the effect of a gain at another rate.

    Args:
        study: The file of the study (.toml).
        store: The store (.zarr), which is written or continued.
        workers: Threads; as many as processors by default.
        scheduler: Address of a Dask scheduler, or a `distributed.Client`, whose workers compute.
        progress: Called with a description and the fraction of the runs that are done.

    Returns:
        For each observer and each combination of values, except starts, initial errors and draws: the number of runs
        that end near the truth, the median error, and the mean NEES and NIS of these runs. With an axis `error`, which
        multiplies the initial error, also the largest multiple up to which all runs end there.

    Raises:
        ValueError: The study is contradictory or too large, or the store belongs to another study. Studies that differ
            only in `below` count as the same.

    Example:
        >>> from pathlib import Path
        >>> from covariant import many
        >>> text = 'model = "oscillator"\\nobservers = ["intrinsic"]\\nrate = 50.0\\nduration = 2.0\\nbelow = 0.05'
        >>> axes = '[set]\\n"measurement.std" = 1e-3\\n"uncertainty.acceleration" = 1.0\\n[axes]\\n'
        >>> axes += '"start.v1" = {low = -2.0, high = 2.0, count = 9}'
        >>> _ = Path("basin.toml").write_text(f"{text}\\n{axes}")
        >>> many.sweep("basin.toml", "basin.zarr").columns["converged"].tolist()
        [1.0]
    """
    out, path = Path(store), Path(study)
    check_output(out, ".zarr", store=True)
    plan = read_study(path)
    progress(f"{path.name}: {plan.grid.size} cases, {plan.steps:.2g} steps of observers; designing them")
    # Convergence is evaluated from finished runs, so a new threshold needs no new runs.
    content = {key: value for key, value in plan.content.items() if key != "below"}
    feedback = content.get("feedback", {"function": "", "folder": ""})
    code = code_hash(feedback["function"], Path(feedback["folder"]))
    runs = Runs(json.dumps(content), (*model_hash(plan.model), *code))
    try:
        result = runs.variables()
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    began: list[tuple[float, int]] = []  # when, and how many cases were there

    def report(done: int, total: int) -> None:
        if not began:
            began.append((time.monotonic(), done))
        progress(f"{path.name}: {done} of {total} cases{time_left(*began[0], done, total)}", done / total)

    try:
        map_grid(
            runs,
            plan.grid,
            out,
            variables=result,
            provenance={"study": content},
            workers=workers,
            scheduler=scheduler,
            on_progress=report,
        )
    except KeyboardInterrupt as stopped:
        raise KeyboardInterrupt("stopped; the same command goes on where it stopped") from stopped
    return SweepResult(path, out, plan)


def _basin(near: Any, scales: Axis) -> dict[str, Any]:
    """The largest multiple of the initial error up to which all runs converge, and how many larger ones do."""
    held = near.cumprod(scales.name)  # 1 up to the first that does not
    largest = (held * held[scales.name].copy(data=np.asarray(scales.values, float))).max(scales.name)
    return {"basin": largest, "beyond it": (near - held).sum(scales.name)}


@dataclass(frozen=True, repr=False)
class SweepResult(AbstractTable):
    """A finished sweep: a row for each observer and combination of values, except starts, initial errors and draws.

    Attributes:
        study: The file of the study.
        store: The Zarr store with the results of all runs.
        plan: The study.

    Example:
        >>> from pathlib import Path
        >>> from covariant import many
        >>> text = 'model = "oscillator"\\nobservers = ["intrinsic"]\\nrate = 50.0\\nduration = 2.0\\n'
        >>> axes = '[set]\\n"measurement.std" = 1e-3\\n"uncertainty.acceleration" = 1.0\\n[axes]\\n"start.v1" = [-1, 1]'
        >>> _ = Path("two.toml").write_text(text + axes)
        >>> many.sweep("two.toml", "two.zarr")
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
        inner = [axis.name for axis in self.plan.axes if axis.inner]
        outer = [axis for axis in self.plan.axes if not axis.inner]
        scales = next((axis for axis in self.plan.axes if axis.key == "error"), None)
        below = self.plan.content.get("below", math.inf)
        rows = []
        for name in self.plan.observers:
            error: Any = stored[f"{plain(name)}_error"]
            finite: Any = error.notnull() & (abs(error) < math.inf)
            count = float(np.prod([stored.sizes[each] for each in inner]))
            near = (error < below) & finite
            parts = ({"converged": near.sum(inner) / count} if below < math.inf else {}) | {
                "not finite": (~finite).sum(inner) / count,
                # A quantile over the chunks of a large store reads each of them once, in order.
                "median error": error.chunk(dict.fromkeys(inner, -1)).quantile(0.5, inner) if inner else error,
            }
            for what, heading in HEADINGS.items():
                if f"{plain(name)}_{what}" in stored:
                    # A run that diverged would dominate the mean.
                    parts[heading] = stored[f"{plain(name)}_{what}"].where(near).mean(inner)
            if scales is not None:
                parts |= _basin(near.all([each for each in inner if each != scales.name]), scales)
            values = {key: np.asarray(part).ravel() for key, part in parts.items()}
            for k, each in enumerate(itertools.product(*(axis.labels for axis in outer))):
                varied = {axis.key: value for axis, value in zip(outer, each, strict=True)}
                rows.append({"observer": name, **varied, **{key: float(part[k]) for key, part in values.items()}})
        names = dict.fromkeys(key for row in rows for key in row)
        kinds = {key: object if isinstance(rows[0].get(key), str) else None for key in names}
        return {key: np.array([row.get(key, math.nan) for row in rows], kind) for key, kind in kinds.items()}

    @property
    def runs(self) -> int:
        """Number of runs of all observers."""
        return self.plan.grid.size * len(self.plan.observers)

    @property
    def _rows(self) -> list[dict[str, Any]]:
        rows = zip(*(c.tolist() for c in self.columns.values()), strict=True)
        return [dict(zip(self.columns, row, strict=True)) for row in rows]

    @property
    def summary(self) -> dict[str, Any]:
        return {"study": str(self.study), "out": str(self.store), "runs": self.runs, "rows": self._rows}

    @property
    def headline(self) -> str:
        below = self.plan.content.get("below")
        rule = "" if below is None else f"; converged is a velocity error below {below:g} in the last fifth"
        return f"{self.runs} runs of {', '.join(self.plan.observers)}{rule}"

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
