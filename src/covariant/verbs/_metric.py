"""`design_metric`: a contraction metric at every point of a grid of states."""

import asyncio
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant import models
from covariant.metrics import Equation, Grid, MetricSummary, metric_on_grid, metric_summary, rate_from_gramian
from covariant.models import ModelFile, Overrides, StateSpace
from covariant.verbs.base.arguments import Amounts, Region, Scheduler, above_zero, bounds, numbers
from covariant.verbs.base.inputs import numbered
from covariant.verbs.base.outputs import check_output
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult
from scalargraph.errors import InputError

PATIENCE = 4.0
"""Seconds after which a scheduler that does not answer counts as absent."""
STATES = 64
"""States of the grid's box from which λ is chosen."""


def design_metric(
    model: Any,
    store: str | Path,
    *,
    grid: int | Sequence[int],
    region: Region | None = None,
    rate: float = 0.0,
    window: float | None = None,
    process_cov: Amounts | None = None,
    measurement_cov: Amounts | None = None,
    start: float = 1.0,
    tolerance: float = 1e-8,
    domain: Region | None = None,
    input: Amounts | None = None,
    block: int = 4096,
    workers: int | None = None,
    scheduler: Scheduler | None = None,
    overrides: Overrides = (),
    progress: Progress = notebook_line,
) -> "MetricResult":
    """Solve the equation of a contraction metric at every point of a grid of states.

    A run that was stopped goes on where it was when the function is called again with the same arguments; of a
    finished store only the summary is computed.

    Use it where `observers.Riccati` shall run in real time, since a look-up is cheap. Time and memory grow as the
    product of the counts of the grid, so it suits systems of two to four states. `metrics.RiccatiMetric` needs no
    store.

    Args:
        model: A model file (.toml), `module:attribute`, the name of a system, a `ModelFile`, or a system, with
            coordinates. A mechanical model becomes the system of its positions and velocities.
        store: The store to write, or to go on with (.zarr).
        grid: Number of points of each axis, one for all axes or one each; four at least to interpolate.
        region: Ends of the axes by state; those not named are the model's own.
        rate: λ of the equation [1/s].
        window: In place of `rate`: λ is chosen from the Gramians of the past, up to this long [s].
        process_cov: Diagonal of Q, one number for each state.
        measurement_cov: Diagonal of R, one number for each output; ones by default.
        start: Metric before the past, as a multiple of the identity.
        tolerance: How much the unknown past may change the metric.
        domain: Where the model holds, as `region`; the past of a state is followed no further.
        input: Constant inputs; zeros by default.
        block: Points that a worker computes at a time.
        workers: Threads; as many as processors by default.
        scheduler: Address of a Dask scheduler, or a `distributed.Client`, whose workers compute.
        overrides: Values that replace those of the model file.
        progress: Called with a description and the fraction of the points that are done.

    Returns:
        How many points have each result, and bounds of the metric.

    Raises:
        ValueError: For an equation or a grid that does not fit the model, or a store of another metric.
        KeyboardInterrupt: Where the run was stopped by Ctrl-C, with how far it came; that is in the store.

    Example:
        >>> import tempfile
        >>> from covariant import verbs
        >>> folder = tempfile.mkdtemp()
        >>> result = verbs.design_metric("unknown_frequency", f"{folder}/metric.zarr", grid=2, rate=8.0)
        >>> result.points
        8
    """
    store = Path(store)
    check_output(store, ".zarr", store=True)
    _check_rates(rate, window, process_cov)
    above_zero("start", start)
    above_zero("tolerance", tolerance)
    if scheduler is not None and workers is not None:
        raise InputError("workers are threads of this process, and those of a scheduler are its own; give one")
    name = models.spec_name(model)
    progress("reading the model")
    file = models.load(model, overrides)
    system = _system(name, file)
    axes = _grid(name, system, grid, region)
    u = None if input is None else jnp.asarray(numbers("input", input, numbered("u", system.inputs)))
    process = _diagonal("process-cov", process_cov, system.coordinates)
    measurement = _diagonal("measurement-cov", measurement_cov, system.outputs)
    equation = Equation(rate if window is None else _rate(system, axes, window, u), process, measurement)
    box = None if domain is None else _domain(system, bounds("domain", domain, system.coordinates))
    if isinstance(scheduler, str):
        _check_scheduler(scheduler)
    done, began = 0, time.perf_counter()

    def report(now: int, total: int) -> None:
        nonlocal done
        done = now
        progress(f"solving {file.name}, {now} of {total} points", now / max(total, 1))

    try:
        metric_on_grid(
            system,
            equation,
            axes,
            store,
            start=float(start),
            tolerance=float(tolerance),
            domain=box,
            u=u,
            name=", ".join((file.name, *_texts(overrides))),  # the store keeps the overrides in the name alone
            block=block,
            workers=workers,
            scheduler=scheduler,
            on_progress=report,
        )
    except KeyboardInterrupt as stopped:
        text = f"stopped after {done} of {axes.size} points; the same command goes on where it stopped"
        raise KeyboardInterrupt(text) from stopped
    seconds = time.perf_counter() - began
    return MetricResult(name, store, axes.size, seconds, float(equation.rate), metric_summary(store))


@dataclass(frozen=True, repr=False)
class MetricResult(AbstractResult):
    """Contraction metric on a grid of states.

    Attributes:
        model_name: The model, by its path or name.
        store: The Zarr store that holds the metric.
        points: Number of points of the grid.
        seconds: Time [s] that the computation took.
        rate: λ [1/s] of the equation.
        found: Number of points with each result, and bounds of the metric over the grid.

    Example:
        >>> import tempfile
        >>> from covariant import verbs
        >>> folder = tempfile.mkdtemp()
        >>> result = verbs.design_metric("unknown_frequency", f"{folder}/metric.zarr", grid=2, rate=8.0)
        >>> result.rate, sum(result.summary["results"].values())
        (8.0, 8)
    """

    model_name: str
    store: Path
    points: int
    seconds: float
    rate: float
    found: MetricSummary

    @property
    def headline(self) -> str:
        return f"{self.store}: {self.points} points, λ = {self.rate:.4g} 1/s"

    @property
    def summary(self) -> dict[str, Any]:
        found = self.found
        measures = {
            "reconstructibility": found.reconstructibility,
            "p_low": found.low,
            "p_high": found.high,
            "error_bound": found.error_bound,
        }
        return {
            "model": self.model_name,
            "out": str(self.store),
            "points": self.points,
            "seconds": self.seconds,
            "rate": self.rate,
            "results": {code.name.lower(): count for code, count in found.results.items()},
            **{key: value if math.isfinite(value) else None for key, value in measures.items()},
        }

    def __str__(self) -> str:
        found = self.found
        return "\n".join(
            [
                f"wrote {self.store}: {self.points} points, λ = {self.rate:.4g} 1/s, {self.seconds:.1f} s",
                *(f"  {count} {code.message}" for code, count in found.results.items()),
                f"smallest reconstructibility {found.reconstructibility:.3g}",
                f"bounds of the metric, equation (9): p_low = {found.low:.3g}, p_high = {found.high:.3g}",
                f"largest error bound {found.error_bound:.2g}",
            ]
        )


def _check_rates(rate: float, window: float | None, process_cov: Amounts | None) -> None:
    if not 0 <= rate < math.inf:
        raise InputError(f"rate must be a number ≥ 0 [1/s]; got {rate}")
    if rate and window is not None:
        raise InputError("rate and window both say what λ is; keep one of them")
    if not rate and window is None and process_cov is None:
        raise InputError("an equation needs λ > 0 by rate or window, Q by process-cov, or both; neither was given")
    if window is not None:
        above_zero("window", window)


def _system(name: str, file: ModelFile) -> StateSpace:
    """The model as a state-space model with names of its states."""
    if not file.model.manifold.commuting:
        raise InputError(
            f"{name} is on a group, and metrics are designed in coordinates; give a StateSpace or a Lagrangian, or use "
            "the observers on groups by `covariant estimate`"
        )
    model = models.state_space(file.model)
    if not model.coordinates:
        raise InputError(f"{name}: the model names no coordinates; give it some: they are the axes of the grid")
    return model


def _box_of(name: str, model: StateSpace, region: Region | None) -> dict[str, tuple[float, float]]:
    """Bounds of every state by name: from `region` if it has them, else from the model's own box."""
    # The box is empty where the model has none, so its length is not checked.
    ends = {name: (float(low), float(high)) for name, (low, high) in zip(model.coordinates, model.box, strict=False)}
    ends |= bounds("region", region or {}, model.coordinates)
    missing = [each for each in model.coordinates if each not in ends]
    if missing:
        example = ",".join(f"{each}=LOW:HIGH" for each in model.coordinates)
        raise InputError(
            f"region lacks {', '.join(missing)}, and {name} has no box of its own; give the ends of all: {example}"
        )
    return ends


def _grid(name: str, model: StateSpace, grid: int | Sequence[int], region: Region | None) -> Grid:
    ends = _box_of(name, model, region)
    units = model.units or ("",) * len(model.coordinates)
    low, high = zip(*(ends[each] for each in model.coordinates), strict=True)
    return Grid(model.coordinates, units, low, high, _counts(grid, model.coordinates))


def _counts(grid: int | Sequence[int], names: Sequence[str]) -> tuple[int, ...]:
    """Number of points along each axis; a single one holds for all axes."""
    counts = (grid,) if isinstance(grid, int) else tuple(grid)
    if len(counts) not in (1, len(names)) or min(counts) < 2:
        raise InputError(
            f"grid needs one count of points for all axes, or {len(names)}, for {', '.join(names)}, each 2 or more; "
            f"got {', '.join(map(str, counts))}"
        )
    return counts if len(counts) == len(names) else counts * len(names)


def _diagonal(argument: str, variances: Amounts | None, names: Sequence[str]) -> Float[Array, "n n"] | None:
    return None if variances is None else jnp.diag(jnp.asarray(numbers(argument, variances, names, positive=True)))


def _rate(model: StateSpace, grid: Grid, longest: float, u: Float[Array, "m"] | None) -> float:
    """λ from the Gramians at fixed random states of the box."""
    low, high = np.asarray(grid.low, float), np.asarray(grid.high, float)
    # A fixed seed: λ is part of the equation, and a run that goes on must have the same one.
    points = np.random.default_rng(0).uniform(low, high, (STATES, len(low)))
    return rate_from_gramian(model, jnp.asarray(points), longest, u)


def _domain(model: StateSpace, ends: Mapping[str, tuple[float, float]]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """The box in which the past is followed, unbounded in the states that it does not name."""
    low, high = zip(*(ends.get(name, (-math.inf, math.inf)) for name in model.coordinates), strict=True)
    return jnp.array(low), jnp.array(high)


def _texts(overrides: Overrides) -> list[str]:
    """The overrides as texts."""
    return [f"{key}={value}" for key, value in overrides.items()] if isinstance(overrides, Mapping) else list(overrides)


def _check_scheduler(address: str) -> None:
    """Contact the scheduler first: a client would wait for half a minute, and leave an empty store behind."""
    try:
        from distributed.comm.core import connect
    except ImportError:
        return  # what is missing, and how to install it, is said where it is used

    async def greet() -> None:
        comm = await asyncio.wait_for(connect(address, timeout=PATIENCE), PATIENCE)
        await comm.close()

    try:
        asyncio.run(greet())
    except (OSError, ValueError, MemoryError) as error:  # MemoryError where something else answers
        raise InputError(
            f"scheduler: no Dask scheduler answers at {address!r} ({error or 'no answer'}); give an address such as "
            "tcp://10.0.0.1:8786"
        ) from error
