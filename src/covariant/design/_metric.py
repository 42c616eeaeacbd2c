"""Contraction metrics over a grid of states.

Source: Sanfelice & Praly 2015, section III.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.geometry import Interpolated
from covariant.models import StateSpace
from covariant.riccati import Box, Equation, metric_at
from covariant.scale import Grid, Variable, map_grid, open_grid
from covariant.signals import Result


def metric(
    model: StateSpace,
    equation: Equation,
    grid: Grid,
    path: str | os.PathLike[str],
    *,
    start: float = 1.0,
    tolerance: float = 1e-8,
    domain: Box | None = None,
    u: Float[Array, "m"] | None = None,
    name: str = "model",
    block: int = 4096,
    scheduler: str | None = None,
    workers: int | None = None,
    on_progress: Callable[[int, int], object] | None = None,
) -> Path:
    """Solve the equation at every point of a grid of states, into the Zarr store at `path`; return that path.

    The store holds `metric` P, `doubt`, `horizon` [s], `reconstructibility` and `result` of `riccati.metric_at`, whose
    options `start`, `tolerance`, `domain` and `u` are; `name` is what the store calls the model. The rest are options
    of `scale.map_grid`, which also says how a run resumes and what it raises.

    Raises `ValueError` where the grid has not one axis for each state.
    """
    n = len(model.coordinates)
    if n and grid.names != model.coordinates:
        raise ValueError(f"the grid has axes {', '.join(grid.names)}; the states are {', '.join(model.coordinates)}")

    def at(x: Array) -> dict[str, Array]:
        solution = metric_at(model, equation, x, start=start, tolerance=tolerance, domain=domain, u=u)
        return solution._asdict()

    provenance = {
        "model": name,
        "parameters": {key: np.asarray(parameter.value).tolist() for key, parameter in model.parameters.items()},
        "equation": _described(equation),
        "start": start,
        "tolerance": tolerance,
        "domain": None if domain is None else [np.asarray(bound).tolist() for bound in domain],
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
    "doubt": Variable((), "1", "bound on the affine-invariant distance to the metric of an endless past"),
    "horizon": Variable((), "s", "length of the past that was used"),
    "reconstructibility": Variable((), "1", "least eigenvalue of the Gramian scaled to a diagonal of ones"),
    "result": Variable((), "1", "; ".join(f"{code.value} {code.name.lower()}" for code in Result)),
}


def load_metric(path: str | os.PathLike[str]) -> Interpolated:
    """The metric of a finished store as a function `x (n,) -> (n, n)`, interpolated between the points of its grid.

    Raises `ValueError` where the store is not one of `metric`, or not finished.
    """
    store = open_grid(path, complete=True)
    if "metric" not in store:
        raise ValueError(f"{path}: the store has no variable 'metric'; make one with design.metric")
    values = store["metric"]
    axes = tuple(np.asarray(store[axis]) for axis in values.dims[:-2])
    return Interpolated(axes, np.asarray(values))


def _described(equation: Equation) -> dict[str, Any]:
    """An equation in what JSON can hold; a field of Q by its name."""
    q, r = equation.process_cov, equation.measurement_cov
    return {
        "rate": float(jnp.asarray(equation.rate)),
        "process_cov": getattr(q, "__qualname__", repr(q))
        if callable(q)
        else None
        if q is None
        else np.asarray(q).tolist(),
        "measurement_cov": None if r is None else np.asarray(r).tolist(),
    }
