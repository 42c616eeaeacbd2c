"""Evaluates a function on a grid: one compiled program runs over the blocks, in threads or in workers of a cluster."""

import contextlib
import functools
import hashlib
import os
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from covariant._cases import Crew, run_chunks
from covariant.metrics import _store
from covariant.metrics._grid import Blocks, Grid, cut
from covariant.metrics._store import Variable
from scalargraph import fingerprint
from scalargraph.errors import InputError

Index = tuple[int, ...]
BATCH = 256
"""Number of points of a block that are computed together."""


def map_grid(
    function: Callable[[Array], Mapping[str, Any]],
    grid: Grid,
    path: str | os.PathLike[str],
    *,
    variables: Mapping[str, Variable],
    provenance: Mapping[str, Any],
    block: int = 4096,
    scheduler: Any = None,
    workers: int | None = None,
    on_progress: Callable[[int, int], object] | None = None,
) -> Path:
    """Evaluate a function at every point of a grid, and write the values to a Zarr store.

    A run that was stopped, killed or failed continues when called again. The store keeps a hash of what the function
    computes, so that a run cannot continue with another function. A function that calls Python has no hash: whenever
    you change it, change the provenance too.

    Args:
        function: maps one point x (n,) [units of the grid] to a dict of arrays of fixed shapes; JAX must be able to
            trace it.
        grid: the grid of points.
        path: path of the store.
        variables: description of each of these arrays, by the array's name.
        provenance: where the function comes from, in values that JSON can represent; it is written to the store.
        block: largest number of points that one worker computes at a time.
        scheduler: address of the scheduler of a Dask cluster, such as "tcp://10.0.0.1:8786", or a `distributed.Client`.
            Its workers then do the computation, and need access to the path. On processors of one kind they write the
            same bytes.
        workers: number of threads of this process, by default one for each processor.
        on_progress: called as `on_progress(done, total)` with numbers of points, first with those already computed,
            then after every block.

    Returns:
        The absolute path of the store.

    Raises:
        ValueError: one line: the function does not match `variables`, or the path holds anything other than an earlier
            run with the same function, grid, variables, provenance and block.
        FileNotFoundError: the folder of the path does not exist.
        ImportError: a package is missing.
        Exception: any error that the function raises.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.metrics import Grid, Variable, map_grid, open_grid
        >>> grid = Grid(("angle",), ("rad",), low=(0.0,), high=(3.0,), counts=(4,))
        >>> potential = Variable((), "J", "potential energy of the pendulum")
        >>> path = map_grid(lambda x: {"potential": -jnp.cos(x[0])}, grid, "potential.zarr",
        ...                 variables={"potential": potential}, provenance={"model": "pendulum"})
        >>> open_grid(path, complete=True).potential.values.round(2).tolist()
        [-1.0, -0.54, 0.42, 0.99]
    """
    crew = Crew(workers, scheduler).check()
    # The path is made absolute, since workers of a cluster have other working folders.
    path, blocks = Path(path).absolute(), cut(grid, block)
    outputs, function_hash = _outputs(function, grid, variables), _function_hash(function, grid)
    _store.prepare(path, _store.configuration(grid, blocks, outputs, provenance, function_hash), blocks)
    written = _store.written(path, len(blocks.sides))
    todo = (index for index in blocks.indices() if index not in written)
    done = sum(map(blocks.size, written))
    report = on_progress or (lambda done, total: None)
    report(done, grid.size)
    if done < grid.size:
        with (
            _store.tidied(path),
            contextlib.closing(run_chunks(_Work(function, str(path), blocks), todo, crew)) as each,
        ):
            for index, result in each:
                if isinstance(result, BrokenExecutor):
                    raise result
                done += blocks.size(index)
                report(done, grid.size)
    _store.finish(path)
    return path


class _Work(NamedTuple):
    """All data that the computation of a block needs."""

    function: Callable[[Array], Mapping[str, Any]]
    path: str
    blocks: Blocks

    def __call__(self) -> Callable[[Index], None]:
        """Compile one program for blocks of the full size; it serves all blocks."""
        points = jax.ShapeDtypeStruct(self.blocks.points((0,) * len(self.blocks.sides)).shape, jnp.float64)
        # Small batches fit in a processor's cache, and few points have to wait for the slowest one.
        program = jax.jit(lambda x: jax.lax.map(self.function, x, batch_size=BATCH)).lower(points).compile()
        return functools.partial(self.compute, program)

    def compute(self, program: Callable[[Any], Any], index: Index) -> None:
        """Evaluate a block, remove the points beyond the grid, and write the rest."""
        region, sides = self.blocks.region(index), self.blocks.sides
        inside = tuple(slice(part.stop - part.start) for part in region)
        values = jax.device_get(program(self.blocks.points(index)))
        cubes = {name: value.reshape(*sides, *value.shape[1:])[inside] for name, value in values.items()}
        _store.write(self.path, region, cubes)


def _function_hash(function: Callable, grid: Grid) -> str | None:
    """Content hash of what a function computes at a point; None if it calls Python."""
    traced = jax.jit(function).trace(jax.ShapeDtypeStruct((len(grid.names),), jnp.float64))
    known = fingerprint(traced.jaxpr)
    if known is not None:
        return known
    # If this library cannot hash an operation, the text of the graph that JAX compiles identifies it.
    text = traced.lower().as_text()
    return None if "callback" in text else hashlib.sha256(text.encode()).hexdigest()


def _outputs(function: Callable, grid: Grid, variables: Mapping[str, Variable]) -> dict[str, dict[str, Any]]:
    """The arrays to store for each variable; raises `ValueError` if the function does not return them."""
    outputs = jax.eval_shape(function, jax.ShapeDtypeStruct((len(grid.names),), jnp.float64))
    if not isinstance(outputs, Mapping) or set(outputs) != set(variables):
        returned = sorted(outputs) if isinstance(outputs, Mapping) else f"a {type(outputs).__name__}"
        raise InputError(
            f"the function must return a dict of {sorted(variables)}, as variables says; it made {returned}"
        )
    sizes: dict[str, int] = {}
    for name, variable in variables.items():
        shape = outputs[name].shape
        if len(variable.dims) != len(shape) or len(set(variable.dims)) != len(shape):
            raise InputError(f"variable {name!r} has shape {shape}; its dims {variable.dims} must name as many axes")
        for dim, size in zip(variable.dims, shape, strict=True):
            if sizes.setdefault(dim, size) != size:
                raise InputError(f"variable {name!r}: {dim!r} has length {size}, but {sizes[dim]} in another variable")
    names = [*grid.names, *sizes, *variables, _store.DONE]
    for name in names:
        if names.count(name) > 1 or not name.isidentifier():
            raise InputError(f"{name!r} cannot name a variable or an axis here: it is taken, or not a plain name")
    return {
        name: {**variable._asdict(), "shape": outputs[name].shape, "dtype": outputs[name].dtype.name}
        for name, variable in variables.items()
    }
