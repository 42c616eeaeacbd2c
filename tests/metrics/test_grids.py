"""Laws of maps over grids: the same numbers whoever computes them, whatever happens on the way."""

import math
import re
import shutil
import tracemalloc
import uuid
from pathlib import Path
from typing import Any

import distributed
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zarr

from covariant.metrics import Grid, Variable, map_grid, open_grid

GRID = Grid(("angle", "rate"), ("rad", "rad/s"), low=(-3.0, -5), high=(3.0, 5), counts=(11, 7))
BLOCK = 9  # blocks of 3 x 3 points, which divide neither count
SETTINGS: Any = {
    "variables": {
        "energy": Variable((), "J", "energy of a pendulum"),
        "moment": Variable(("row", "column"), "1", "outer product of the state"),
        "code": Variable((), "1", "index of the largest coordinate"),
        "upright": Variable((), "1", "whether the pendulum is above its joint"),
    },
    "provenance": {"model": "pendulum", "gains": (1.0, 2.5)},
}
LEVEL: Any = {"variables": {"level": Variable((), "1", "a number")}, "provenance": {}}


def observables(x):
    energy = jnp.sum(x[1:] ** 2) / 2 - jnp.cos(x[0])
    return {"energy": energy, "moment": jnp.outer(x, x), "code": jnp.argmax(x), "upright": jnp.cos(x[0]) < 0}


def on_host(see):
    """A function whose value is worked out by `see`, which is given whole batches of points (points, n)."""

    def level(x):
        shape = jax.ShapeDtypeStruct((), jnp.float64)
        return {"level": jax.pure_callback(see, shape, x, vmap_method="broadcast_all")}

    return level


def expected(grid: Grid, function=observables) -> dict[str, np.ndarray]:
    """The function at all points of a grid at once."""
    points = np.stack(np.meshgrid(*grid.axes, indexing="ij"), -1).reshape(-1, len(grid.shape))
    values = jax.device_get(jax.jit(jax.vmap(function))(points))
    return {name: value.reshape(*grid.shape, *value.shape[1:]) for name, value in values.items()}


def check_values(path: Path, grid: Grid) -> None:
    found = open_grid(path, complete=True)
    for name, value in expected(grid).items():
        assert found[name].dtype == value.dtype
        np.testing.assert_allclose(found[name].values, value, rtol=1e-14, atol=1e-14)
    for name, units, axis in zip(grid.names, grid.units, grid.axes, strict=True):
        np.testing.assert_array_equal(found[name].values, axis)
        assert found[name].attrs["units"] == units


def chunks(path: Path) -> dict[str, bytes]:
    """All files of a store but the one that holds the time of its making, and what a killed writer left."""
    files = [file for file in path.rglob("*") if file.is_file() and file.suffix != ".partial"]
    return {str(file.relative_to(path)): file.read_bytes() for file in files if file != path / "zarr.json"}


def finished(path: Path) -> list[tuple[int, ...]]:
    return [tuple(map(int, file.parts[-2:])) for file in path.glob("done/c/*/*") if file.name.isdecimal()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A map made in one go by threads."""
    return map_grid(observables, GRID, tmp_path_factory.mktemp("whole") / "map.zarr", block=BLOCK, **SETTINGS)


@pytest.fixture(scope="module")
def cluster():
    """Address of a cluster of two worker processes."""
    local: Any = distributed.LocalCluster
    with local(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0") as made:
        yield made.scheduler_address


def test_the_dataset_says_what_it_holds_and_where_it_comes_from(whole):
    found = open_grid(whole)
    assert list(found) == list(SETTINGS["variables"])
    assert found.moment.dims == ("angle", "rate", "row", "column")
    assert found.moment.chunks, "it is read when it is asked for"
    assert found.energy.attrs == {"units": "J", "description": "energy of a pendulum"}
    assert found.attrs["provenance"] == {"model": "pendulum", "gains": [1.0, 2.5]}
    assert found.attrs["complete"] is True
    (versions,) = found.attrs["versions"]
    assert versions["jax"] == jax.__version__
    assert versions["numpy"] == np.__version__
    assert len(found.attrs["digest"]) == 64


@pytest.mark.parametrize("where", ["threads", "cluster"])
def test_every_process_compiles_once(where, request, tmp_path):
    traces = tmp_path / "traces"
    traces.mkdir()

    def level(x):
        (traces / uuid.uuid4().hex).touch()  # Python runs this when it traces, and never when it computes
        return {"level": x[0]}

    crew: dict[str, Any] = {"scheduler": request.getfixturevalue("cluster")} if where == "cluster" else {"workers": 3}
    map_grid(level, GRID, tmp_path / "map.zarr", block=4, **LEVEL, **crew)
    processes = 2 if where == "cluster" else 1
    assert 2 <= len(list(traces.iterdir())) <= 1 + processes  # the first one is for the shapes


def test_what_killed_writers_left_is_swept_by_the_next_run(tmp_path):
    path = tmp_path / "map.zarr"
    with pytest.raises(RuntimeError):
        map_grid(observables, GRID, path, block=BLOCK, workers=1, on_progress=stop_after(2), **SETTINGS)
    (tmp_path / f".map.zarr.{32 * 'a'}.tmp" / "c").mkdir(parents=True)
    part = next(path.glob("done/c/*")) / f"0.{32 * 'b'}.partial"
    part.touch()
    map_grid(observables, GRID, path, block=BLOCK, **SETTINGS)
    assert not part.exists()
    assert [p.name for p in tmp_path.iterdir()] == ["map.zarr"]


@pytest.mark.parametrize("name", ["energy", "moment", "code", "upright"])
def test_a_lost_chunk_is_found_and_computed_again(whole, tmp_path, name):
    """Though its flag is set, and others hold nothing but the fill value: a map of False, of 0 or of NaN."""
    path, seen = tmp_path / "map.zarr", []
    shutil.copytree(whole, path)
    chunk = next(file for file in (path / name / "c" / "1" / "2", *path.glob(f"{name}/c/1/2/**/0")) if file.is_file())
    chunk.unlink()
    for complete in (True, False):
        with pytest.raises(
            ValueError, match=r"map\.zarr is not complete: 1 of 12 blocks are missing; run its map_grid"
        ):
            open_grid(path, complete=complete)
    map_grid(observables, GRID, path, block=BLOCK, on_progress=lambda *done: seen.append(done), **SETTINGS)
    assert seen[0] == (74, 77), "3 points of one block"
    assert chunks(path) == chunks(whole)
    check_values(path, GRID)


def stop_after(blocks: int):
    calls = iter(range(blocks))

    def report(done, total):
        if next(calls, None) is None:
            raise RuntimeError("enough")

    return report


def test_a_lost_chunk_of_an_unfinished_map_is_not_read_as_zero(tmp_path):
    path = tmp_path / "map.zarr"
    with pytest.raises(RuntimeError, match="enough"):
        map_grid(observables, GRID, path, block=BLOCK, workers=1, on_progress=stop_after(4), **SETTINGS)
    open_grid(path)
    next(file for file in sorted(path.glob("code/c/**/*")) if file.is_file()).unlink()
    with pytest.raises(ValueError, match="blocks are missing; run its map_grid again"):
        open_grid(path)
    map_grid(observables, GRID, path, block=BLOCK, **SETTINGS)
    check_values(path, GRID)


def test_points_never_computed_read_as_nan(whole, tmp_path):
    path, calls = tmp_path / "map.zarr", iter(range(6))

    def interrupt(done, total):
        if next(calls) == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        map_grid(observables, GRID, path, block=BLOCK, workers=1, on_progress=interrupt, **SETTINGS)
    done = np.zeros(GRID.shape, bool)
    for k, m in finished(path):
        done[3 * k : 3 * k + 3, 3 * m : 3 * m + 3] = True
    assert 0 < done.sum() < done.size
    found = open_grid(path)
    for name, value in expected(GRID).items():
        np.testing.assert_allclose(found[name].values[done], value[done], rtol=1e-14, atol=1e-14)
        assert np.isnan(found[name].values[~done]).all()
        assert found[name].attrs["units"] == SETTINGS["variables"][name].units
    map_grid(observables, GRID, path, block=BLOCK, **SETTINGS)
    assert chunks(path) == chunks(whole)


def test_an_exception_surfaces_and_the_run_goes_on_later(tmp_path):
    path, batches, broken = tmp_path / "map.zarr", [], [True]

    def see(x):
        if broken[0] and len(batches) == 5:
            raise ArithmeticError("no value there")
        batches.append(x.shape)
        return x.sum(-1)

    with pytest.raises(Exception, match="ArithmeticError: no value there"):
        map_grid(on_host(see), GRID, path, block=BLOCK, workers=1, **LEVEL)
    assert len(finished(path)) == 5
    broken[0] = False
    map_grid(on_host(see), GRID, path, block=BLOCK, workers=1, **LEVEL)
    assert batches == [(9, 2)] * 12, "every block once, all of one size"
    points = np.stack(np.meshgrid(*GRID.axes, indexing="ij"), -1)
    np.testing.assert_array_equal(open_grid(path, complete=True).level.values, points.sum(-1))


def test_an_exception_of_a_worker_process_surfaces(cluster, tmp_path):
    def see(x):
        raise ArithmeticError("no value there")

    with pytest.raises(Exception, match="ArithmeticError: no value there"):
        map_grid(on_host(see), GRID, tmp_path / "map.zarr", block=BLOCK, scheduler=cluster, **LEVEL)
    map_grid(lambda x: {"level": x[0]}, GRID, tmp_path / "map.zarr", block=BLOCK, scheduler=cluster, **LEVEL)
    open_grid(tmp_path / "map.zarr", complete=True)


@pytest.mark.long
def test_a_grid_of_a_million_million_points_takes_the_memory_of_its_blocks(tmp_path):
    grid, batches = Grid(("a", "b"), ("m", "m"), (0, 0), (1, 1), (10**6, 10**6)), []

    def see(x):
        batches.append(len(x))
        return x.sum(-1)

    def stop(done, total):
        assert total == 10**12
        if done > 10_000:
            raise KeyboardInterrupt

    tracemalloc.start()
    with pytest.raises(KeyboardInterrupt):
        map_grid(on_host(see), grid, tmp_path / "map.zarr", workers=1, on_progress=stop, **LEVEL)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert set(batches) == {256}
    assert peak < 1e8, "both axes are 16 MB, the grid would be 16 TB"
    assert math.isclose(open_grid(tmp_path / "map.zarr").level[5, 7], 12 / (10**6 - 1))


def test_what_is_no_map_is_refused_and_left_alone(tmp_path):
    (tmp_path / "file").write_text("kept")
    (tmp_path / "folder").mkdir()
    zarr.create_group(str(tmp_path / "group"), attributes={"complete": True})
    for name in ("file", "folder", "group"):
        for act in (lambda path: map_grid(observables, GRID, path, **SETTINGS), open_grid):
            with pytest.raises(ValueError, match=rf"{name} is not a map made by map_grid; give another path"):
                act(tmp_path / name)
    with pytest.raises(ValueError, match="absent is not a map"):
        open_grid(tmp_path / "absent")
    with pytest.raises(FileNotFoundError):
        map_grid(observables, GRID, tmp_path / "absent" / "map.zarr", **SETTINGS)
    assert (tmp_path / "file").read_text() == "kept"
    assert not list((tmp_path / "folder").iterdir())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "group"]


@pytest.mark.core(1)
@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"low": (3.0, -5)}, "axis 'angle': low must be below high, both finite; got 3.0 and 3.0"),
        ({"high": (3.0, math.inf)}, "axis 'rate': low must be below high"),
        ({"counts": (11, 1)}, "axis 'rate': the count must be a whole number, 2 or more; got 1"),
        ({"counts": (11,)}, "a grid needs a name, a unit"),
        ({"names": ("rate", "rate")}, "axis 'rate': two axes have this name"),
        ({"names": ("rate", "a/b")}, "axis 'a/b': use a name"),
    ],
)
def test_a_wrong_grid_is_refused_by_the_name_of_its_axis(change, word):
    fields = {name: getattr(GRID, name) for name in ("names", "units", "low", "high", "counts")}
    with pytest.raises(ValueError, match=re.escape(word)):
        Grid(**fields | change)
