"""`covariant design metric`: a contraction metric on a grid of states."""

import asyncio
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from covariant import design, models
from covariant._numbers import integer
from covariant.cli import _parse
from covariant.design import MetricSummary, metric_summary
from covariant.models import StateSpace
from covariant.riccati import Equation, rate_from_gramian
from covariant.scale import Grid
from covariant.workflow._outputs import check_output

PATIENCE = 4.0
"""Seconds after which a scheduler that does not answer counts as absent."""


class Task(NamedTuple):
    """The equation and grid, in the options of the command as the user gave them."""

    box: str | None
    grid: str
    rate: float
    window: float | None
    process_cov: str | None
    measurement_cov: str | None
    start: float
    tolerance: float
    domain: str | None
    input: str | None


class Crew(NamedTuple):
    """The workers: number of points of a block, and threads of this process or the address of a scheduler."""

    block: int
    workers: int | None
    scheduler: str | None


def metric(spec: str, overrides: tuple[str, ...], out: Path, task: Task, crew: Crew, as_json: bool) -> None:
    """Solve the equation at every point of the grid, or continue a run that was stopped, and summarise the store."""
    check_output(out, ".zarr", store=True)
    file = models.load(spec, overrides)
    model = _model(spec, file)
    grid = _grid(spec, model, task)
    equation = _equation(model, task, grid)
    settings: dict[str, Any] = {
        "start": _parse.above_zero("--start", task.start),
        "tolerance": _parse.above_zero("--tolerance", task.tolerance),
        "domain": _domain(model, task.domain),
        "u": _array(_parse.numbers("--input", task.input, [f"u{i + 1}" for i in range(model.inputs)])),
        # The overrides are stored only in the name.
        "name": ", ".join((file.name, *overrides)),
        **crew._asdict(),
    }
    _check_crew(crew)
    done, began = 0, time.perf_counter()
    try:
        with _points(f"solving {file.name}", quiet=as_json) as show:

            def report(now: int, total: int) -> None:
                nonlocal done
                done = now
                show(now, total)

            design.metric(model, equation, grid, out, on_progress=report, **settings)
        found = metric_summary(out)
    except KeyboardInterrupt:
        print(
            f"covariant: stopped after {done} of {grid.size} points; the same command goes on where it stopped",
            file=sys.stderr,
        )
        raise SystemExit(130) from None
    result = {"model": spec, "out": str(out), "points": grid.size, "seconds": time.perf_counter() - began}
    result["rate"] = float(equation.rate)
    result |= _in_json(found)
    print(json.dumps(result) if as_json else _text(result, found))


def _model(spec: str, file: models.ModelFile) -> StateSpace:
    if not file.model.manifold.commuting:
        raise ValueError(
            f"{spec} is on a group, and metrics are designed in coordinates; give a StateSpace or a Lagrangian, or use "
            "the observers on groups by `covariant estimate`"
        )
    model = models.state_space(file.model)
    if not model.coordinates:
        raise ValueError(f"{spec}: the model names no coordinates; give it some: they are the axes of the grid")
    return model


def _grid(spec: str, model: StateSpace, task: Task) -> Grid:
    own = {name: (float(low), float(high)) for name, (low, high) in zip(model.coordinates, model.box, strict=False)}
    box = own | _parse.ends("--box", task.box, model.coordinates)
    missing = [name for name in model.coordinates if name not in box]
    if missing:
        example = ",".join(f"{name}=LOW:HIGH" for name in model.coordinates)
        raise ValueError(f"--box lacks {', '.join(missing)}, and {spec} has no box of its own; give --box {example}")
    units = model.units or ("",) * len(model.coordinates)
    low, high = zip(*(box[name] for name in model.coordinates), strict=True)
    return Grid(model.coordinates, units, low, high, _counts(task.grid, model))


def _counts(text: str, model: StateSpace) -> tuple[int, ...]:
    """Number of points along each axis; a single one holds for all axes."""
    n = len(model.coordinates)
    try:
        counts = tuple(integer(part) for part in text.split(","))
    except ValueError:
        counts = ()
    if len(counts) not in (1, n) or min(counts) < 2:
        raise ValueError(
            f"--grid: {text!r} is not one count of points for all axes, or {n} by commas for "
            f"{', '.join(model.coordinates)}, each 2 or more"
        )
    return counts if len(counts) == n else counts * n


def _equation(model: StateSpace, task: Task, grid: Grid) -> Equation:
    if not 0 <= task.rate < math.inf:
        raise ValueError(f"--rate must be a number ≥ 0 [1/s]; got {task.rate}")
    if task.rate and task.window is not None:
        raise ValueError("--rate and --window both say what λ is; keep one of them")
    if not task.rate and task.window is None and task.process_cov is None:
        raise ValueError("an equation needs λ > 0 by --rate or --window, --process-cov Q, or both; neither was given")
    rate = task.rate if task.window is None else _rate(model, task, grid, _parse.above_zero("--window", task.window))
    q = _parse.numbers("--process-cov", task.process_cov, model.coordinates, positive=True)
    r = _parse.numbers("--measurement-cov", task.measurement_cov, model.outputs, positive=True)
    return Equation(rate, *(None if entries is None else jnp.diag(entries) for entries in (q, r)))


def _rate(model: StateSpace, task: Task, grid: Grid, longest: float) -> float:
    """λ from the Gramians at fixed random states of the box."""
    low, high = np.asarray(grid.low, float), np.asarray(grid.high, float)
    points = np.random.default_rng(0).uniform(low, high, (64, len(low)))
    u = _array(_parse.numbers("--input", task.input, [f"u{i + 1}" for i in range(model.inputs)]))
    return rate_from_gramian(model, jnp.asarray(points), longest, u)


def _domain(model: StateSpace, text: str | None):
    """The box in which the past is followed, unbounded in the states that it does not name."""
    if text is None:
        return None
    ends = _parse.ends("--domain", text, model.coordinates)
    low, high = zip(*(ends.get(name, (-math.inf, math.inf)) for name in model.coordinates), strict=True)
    return jnp.array(low), jnp.array(high)


def _array(values: np.ndarray | None):
    return None if values is None else jnp.asarray(values)


def _check_crew(crew: Crew) -> None:
    """Contact the scheduler first: a client would wait for half a minute, and leave an empty store behind."""
    if crew.scheduler is None:
        return
    if crew.workers is not None:
        raise ValueError("--workers are threads of this process, and the workers of --scheduler its own; give one")
    try:
        from distributed.comm.core import connect
    except ImportError:
        return  # what is missing, and how to install it, is said where it is used

    async def greet(address: str) -> None:
        comm = await asyncio.wait_for(connect(address, timeout=PATIENCE), PATIENCE)
        await comm.close()

    try:
        asyncio.run(greet(crew.scheduler))
    except (OSError, ValueError, MemoryError) as error:  # MemoryError where something else answers
        raise ValueError(
            f"--scheduler: no Dask scheduler answers at {crew.scheduler!r} ({error or 'no answer'}); give an address "
            "such as tcp://10.0.0.1:8786"
        ) from error


@contextmanager
def _points(what: str, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A progress bar in points, with their rate and the time left; yields a function of the points done and of all."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task) -> Text:
            return Text("" if task.speed is None else f"{task.speed:.0f} points/s")

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn()
    console = Console(stderr=True)
    settings: dict[str, Any] = {"transient": True, "disable": quiet or not console.is_interactive}
    # A block may take minutes, and an estimate of the rate needs two blocks.
    with Progress(*columns, console=console, speed_estimate_period=3600.0, **settings) as progress:
        task = None

        def show(done: int, total: int) -> None:
            nonlocal task
            if task is None:  # created here, so that points of an earlier run do not count for the rate
                task = progress.add_task(what, total=total, completed=done)
            progress.update(task, completed=done)

        yield show


def _in_json(found: MetricSummary) -> dict[str, Any]:
    """A summary as JSON data: None for a number that no point has, and counts of points by the name of their result."""
    numbers = {
        "reconstructibility": found.reconstructibility,
        "p_low": found.low,
        "p_high": found.high,
        "error_bound": found.error_bound,
    }
    results = {code.name.lower(): count for code, count in found.results.items()}
    return {"results": results, **{k: v if math.isfinite(v) else None for k, v in numbers.items()}}


def _text(result: dict[str, Any], found: MetricSummary) -> str:
    return "\n".join(
        [
            f"wrote {result['out']}: {result['points']} points, λ = {result['rate']:.4g} 1/s, "
            f"{result['seconds']:.1f} s",
            *(f"  {count} {code.message}" for code, count in found.results.items()),
            f"smallest reconstructibility {found.reconstructibility:.3g}",
            f"bounds of the metric, equation (9): p_low = {found.low:.3g}, p_high = {found.high:.3g}",
            f"largest error bound {found.error_bound:.2g}",
        ]
    )
