"""Computes contraction metrics on a grid of states.

Source: Sanfelice & Praly 2015, section III.
"""

import itertools
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Bounds
from covariant.geometry import Interpolated
from covariant.metrics import Equation, Grid, Variable, map_grid, metric_at, open_grid
from covariant.models import StateSpace
from covariant.signals import StepCode
from scalargraph.errors import InputError


def metric_on_grid(
    model: StateSpace,
    equation: Equation,
    grid: Grid,
    path: str | os.PathLike[str],
    *,
    start: float = 1.0,
    tolerance: float = 1e-8,
    domain: Bounds | None = None,
    u: Float[Array, "m"] | None = None,
    name: str = "model",
    block: int = 4096,
    scheduler: str | None = None,
    workers: int | None = None,
    on_progress: Callable[[int, int], object] | None = None,
) -> Path:
    """Solve the Riccati equation at every point of a grid of states, and write the solutions to a Zarr store.

    The store holds the fields of a `metrics.Solution`: `metric` P, `error_bound`, `horizon` [s], `reconstructibility`
    and `result`.

    Args:
        model: system with state x (n,) and output y (p,).
        equation: the Riccati equation.
        grid: grid of states; its axes are the coordinates of the model, in order.
        path: path of the store.
        start: option of `metrics.metric_at`, as a multiple of I.
        tolerance: option of `metrics.metric_at`, 1e-8 by default.
        domain: option of `metrics.metric_at`.
        u: option of `metrics.metric_at`.
        name: name of the model in the store.
        block: option of `metrics.map_grid`, which also describes how a run resumes and what it raises.
        scheduler: option of `metrics.map_grid`.
        workers: option of `metrics.map_grid`.
        on_progress: option of `metrics.map_grid`.

    Returns:
        The absolute path of the store.

    Raises:
        ValueError: the axes of the grid differ from the states.

    Example:
        For x' = 0, y = x and λ = 2 the solution is P = 1/λ everywhere:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics import Equation, Grid, load_metric, metric_on_grid
        >>> from covariant.models import StateSpace
        >>> model = StateSpace(lambda t, x, u: 0.0 * x, lambda t, x, u: x)
        >>> grid = Grid(("level",), ("m",), low=(0.0,), high=(1.0,), counts=(5,))
        >>> path = metric_on_grid(model, Equation(rate=2.0), grid, "level.zarr")
        >>> round(float(load_metric(path)(jnp.array([0.3]))[0, 0]), 6)
        0.5
    """
    n = len(model.coordinates)
    if n and tuple(grid.names) != model.coordinates:
        raise InputError(f"the grid has axes {', '.join(grid.names)}; the states are {', '.join(model.coordinates)}")

    def at(x: Array) -> dict[str, Array]:
        solution = metric_at(model, equation, x, start=start, tolerance=tolerance, domain=domain, u=u)
        return solution._asdict()

    provenance = {
        "model": name,
        "parameters": {key: np.asarray(parameter.value).tolist() for key, parameter in model.parameters.items()},
        "equation": _describe_equation(equation),
        "start": start,
        "tolerance": tolerance,
        "domain": None if domain is None else [_finite_or_none(bound) for bound in domain],
        "u": None if u is None else np.asarray(u).tolist(),
        "source": "Sanfelice & Praly 2015, section III",
    }
    return map_grid(
        at,
        grid,
        path,
        variables=VARIABLES,
        provenance=provenance,
        block=block,
        scheduler=scheduler,
        workers=workers,
        on_progress=on_progress,
    )


VARIABLES = {
    "metric": Variable(("row", "column"), "1", "contraction metric P, covariant: entry (i, j) goes with dx_i dx_j"),
    "error_bound": Variable((), "1", "bound on the affine-invariant distance to the metric of an endless past"),
    "horizon": Variable((), "s", "length of the past that was used"),
    "reconstructibility": Variable((), "1", "least eigenvalue of the Gramian scaled to a diagonal of ones"),
    "result": Variable((), "1", "; ".join(f"{code.value} {code.name.lower()}" for code in StepCode)),
}


def load_metric(path: str | os.PathLike[str]) -> Interpolated:
    """Load the metric of a finished store of `metric_on_grid`, interpolated between the points of its grid.

    Use it to give a stored metric to `observers.Riccati`: a look-up is far cheaper than `RiccatiMetric`. There is no
    metric outside the grid; inside, the accuracy depends on its spacing. `verbs.design_metric` writes such a store.

    Args:
        path: path of the store.

    Returns:
        The metric as a function `x (n,) -> (n, n)`.

    Raises:
        ValueError: the store was not written by `metric_on_grid`, or is not finished.
    """
    return _field(open_metric(path))


def _field(store: Any) -> Interpolated:
    values = store["metric"]
    axes = tuple(np.asarray(store[axis]) for axis in values.dims[:-2])
    return Interpolated(axes, np.asarray(values))


class MetricSummary(NamedTuple):
    """Summary of a finished store of `metric_on_grid`; a number that no point has is NaN.

    Attributes:
        results: number of points with each `covariant.signals.StepCode`; results without points are left out.
        reconstructibility: the smallest value in the domain.
        low: lower bound of equation (9), `low I ≤ P ≤ high I`, over the points that have a metric; it depends on the
            units of the coordinates.
        high: upper bound of equation (9).
        error_bound: the largest known bound, over the same points.

    Example:
        >>> from covariant.metrics import Equation, Grid, metric_on_grid, metric_summary
        >>> from covariant.models import StateSpace
        >>> model = StateSpace(lambda t, x, u: 0.0 * x, lambda t, x, u: x)
        >>> grid = Grid(("level",), ("m",), low=(0.0,), high=(1.0,), counts=(5,))
        >>> summary = metric_summary(metric_on_grid(model, Equation(rate=2.0), grid, "levels.zarr"))
        >>> {result.name: count for result, count in summary.results.items()}, round(summary.low, 6)
        ({'OK': 5}, 0.5)
    """

    results: dict[StepCode, int]
    reconstructibility: float
    low: float
    high: float
    error_bound: float


def metric_summary(path: str | os.PathLike[str]) -> MetricSummary:
    """Summarise a finished store of `metric_on_grid`, with only some of its blocks in memory at a time.

    Args:
        path: path of the store.

    Returns:
        Counts of results, and bounds over the points.

    Raises:
        ValueError: the store was not written by `metric_on_grid`, or is not finished.
    """
    store = open_metric(path)
    parts = [_part(store.isel(region).load()) for region in _regions(store)]
    counts = np.sum([counts for counts, _ in parts], axis=0)
    reconstructibility, low, high, error_bound = np.array([values for _, values in parts]).T
    return MetricSummary(
        {code: int(count) for code, count in zip(StepCode, counts, strict=True) if count},
        float(np.fmin.reduce(reconstructibility)),
        float(np.fmin.reduce(low)),
        float(np.fmax.reduce(high)),
        float(np.fmax.reduce(error_bound)),
    )


def open_metric(path: str | os.PathLike[str]) -> Any:
    """Open a finished store of `metric_on_grid` as a dataset of xarray.

    Args:
        path: path of the store.

    Returns:
        Lazy `xarray.Dataset` with the variables of `metric_on_grid`.

    Raises:
        ValueError: the store was not written by `metric_on_grid`, or is not finished.
    """
    store = open_grid(path, complete=True)
    if set(store) != set(VARIABLES):
        raise InputError(
            f"{path} holds {', '.join(map(str, store))} and no metric of metrics.metric_on_grid; give another path"
        )
    return store


def _regions(store: Any) -> Iterator[dict[str, slice]]:
    """Boxes that cover the grid and are small enough for memory: the chunks in which the metric is read."""
    metric = store["metric"]
    ends = [np.cumsum((0, *sizes)) for sizes in metric.chunks[:-2]]
    sides = [[slice(int(a), int(b)) for a, b in itertools.pairwise(end)] for end in ends]
    for box in itertools.product(*sides):
        yield dict(zip(metric.dims[:-2], box, strict=True))


def _part(store: Any) -> tuple[np.ndarray, tuple[float, ...]]:
    """Counts of the results; then least reconstructibility, least and largest eigenvalue, and largest error bound."""
    result, metric = store["result"].values, store["metric"].values
    known = np.isfinite(metric).all(axis=(-2, -1))
    # A block without any metric gives NaN, which `fmin` and `fmax` ignore.
    values = np.linalg.eigvalsh(metric[known]) if known.any() else np.full((1, 1), np.nan)
    inside = np.where(result != StepCode.OUT_OF_DOMAIN, store["reconstructibility"].values, np.nan)
    error_bound = np.where(known, store["error_bound"].values, np.nan)
    ends = (np.fmin.reduce(inside, axis=None), values.min(), values.max(), np.fmax.reduce(error_bound, axis=None))
    # The counts have the same length in every block, so that they can be added.
    return np.bincount(result.ravel(), minlength=len(StepCode)), tuple(map(float, ends))


def _finite_or_none(bound: Array) -> list[float | None]:
    """A bound as JSON data, with None for infinity."""
    return [value if math.isfinite(value) else None for value in np.asarray(bound).tolist()]


def _describe_equation(equation: Equation) -> dict[str, Any]:
    """An equation as JSON data; a field Q is represented by its name."""

    def as_json(cov: Callable | Array | None) -> Any:
        if callable(cov):
            return getattr(cov, "__qualname__", repr(cov))
        return None if cov is None else np.asarray(cov).tolist()

    q, r = equation.process_cov, equation.measurement_cov
    return {"rate": float(jnp.asarray(equation.rate)), "process_cov": as_json(q), "measurement_cov": as_json(r)}
