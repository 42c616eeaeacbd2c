"""Laws of maps over grids: the same numbers whoever computes them, whatever happens on the way: what takes long."""

import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import zarr
from hypothesis import given, settings, strategies as st
from test_grids import BLOCK, GRID, LEVEL, SETTINGS, check_values, chunks, cluster, finished, observables, whole

from covariant.metrics import Grid, Variable, map_grid, open_grid


def chunk_times(path: Path, blocks) -> dict[Path, int]:
    found = [file for k, m in blocks for file in path.glob(f"*/c/{k}/{m}/**/*") if file.is_file()]
    found += [file for k, m in blocks for file in path.glob(f"*/c/{k}/{m}") if file.is_file()]
    return {file: file.stat().st_mtime_ns for file in found if file.suffix != ".partial"}


@pytest.mark.exhaustive
@settings(max_examples=10)
@given(counts=st.lists(st.integers(2, 6), min_size=1, max_size=3), block=st.integers(2, 30))
def test_values_are_those_of_the_function_whatever_the_blocks(tmp_path_factory, counts, block):
    n = len(counts)
    grid = Grid([f"x{k}" for k in range(n)], ["m"] * n, [-1.0] * n, [2.0] * n, counts)
    path = tmp_path_factory.mktemp("any") / "map.zarr"
    sizes = []
    assert map_grid(observables, grid, path, block=block, on_progress=lambda *p: sizes.append(p), **SETTINGS) == path
    check_values(path, grid)
    done, totals = zip(*sizes, strict=True)
    assert done[0] == 0
    assert done[-1] == grid.size
    assert set(totals) == {grid.size}
    assert 0 < min(np.diff(done)) <= max(np.diff(done)) <= block


@pytest.mark.parametrize("where", ["one worker", "processes"])
def test_whoever_works_writes_the_bytes_of_many_threads(where, whole, request, tmp_path):
    path, seen = tmp_path / "map.zarr", []
    crew: Any = {"workers": 1} if where == "one worker" else {"scheduler": request.getfixturevalue("cluster")}
    map_grid(observables, GRID, path, block=BLOCK, on_progress=lambda *p: seen.append(p[0]), **crew, **SETTINGS)
    check_values(path, GRID)
    assert chunks(path) == chunks(whole)
    assert seen == sorted(seen)
    assert (seen[0], seen[-1]) == (0, GRID.size)


def run_until_killed(path: str, blocks: int) -> None:
    """In a process of its own: a run that is killed after so many blocks, the other threads still writing."""
    calls = iter(range(blocks + 1))

    def die(done, total):
        if next(calls) == blocks:
            os.kill(os.getpid(), signal.SIGKILL)

    map_grid(observables, GRID, path, block=BLOCK, on_progress=die, **SETTINGS)


@pytest.mark.exhaustive
def test_a_killed_run_goes_on_where_it_was(whole, tmp_path):
    path, seen = tmp_path / "map.zarr", []
    script = f"import test_grids; test_grids.run_until_killed({str(path)!r}, 4)"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    killed = subprocess.run([sys.executable, "-c", script], env=environment, check=False)
    assert killed.returncode == -signal.SIGKILL
    before = finished(path)
    times = chunk_times(path, before)
    assert 4 <= len(before) < 12
    with pytest.raises(ValueError, match=rf"map\.zarr is not complete: {12 - len(before)} of 12 blocks are missing"):
        open_grid(path, complete=True)
    map_grid(observables, GRID, path, block=BLOCK, on_progress=lambda *p: seen.append(p[0]), **SETTINGS)
    assert len(seen) == 1 + 12 - len(before)
    assert seen[0] > 0
    assert chunk_times(path, before) == times
    assert chunks(path) == chunks(whole)
    check_values(path, GRID)


@pytest.mark.exhaustive("change1-provenance.gains")
@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"grid": GRID.__class__(GRID.names, GRID.units, GRID.low, GRID.high, (11, 8))}, "grid.counts"),
        ({"provenance": {"model": "pendulum", "gains": (1.0, 2.6)}}, "provenance.gains"),
        ({"variables": SETTINGS["variables"] | {"code": Variable((), "one", "")}}, "variables.code.units"),
        ({"block": 4}, "block is [3, 3] there and [2, 2] here"),
    ],
)
def test_a_store_of_another_configuration_is_left_alone(whole, change, word):
    before = chunks(whole), (whole / "zarr.json").read_bytes()
    changed = {"grid": GRID, "block": BLOCK, **SETTINGS, **change}
    with pytest.raises(ValueError, match=re.escape(f"{whole} holds another map: {word}")):
        map_grid(observables, path=whole, **changed)
    assert (chunks(whole), (whole / "zarr.json").read_bytes()) == before


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"variables": {}}, "must return a dict of []"),
        ({"variables": SETTINGS["variables"] | {"energy": Variable(("row",), "J", "")}}, "'energy' has shape ()"),
        ({"variables": SETTINGS["variables"] | {"moment": Variable(("a", "a"), "1", "")}}, "'moment' has shape (2, 2)"),
        ({"variables": SETTINGS["variables"] | {"moment": Variable(("rate", "a"), "1", "")}}, "'rate' cannot name"),
        ({"provenance": {"rate": math.nan}}, "provenance must be made of"),
        ({"block": 0}, "a block needs at least one point; got 0"),
        ({"workers": 0}, "workers must be 1 or more; got 0"),
        ({"workers": 2, "scheduler": "tcp://nowhere:1"}, "give scheduler or workers, not both"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_written(tmp_path, change, word):
    with pytest.raises(ValueError, match=re.escape(word)):
        map_grid(observables, GRID, tmp_path / "map.zarr", **SETTINGS | change)
    assert not list(tmp_path.iterdir())


@pytest.mark.exhaustive
def test_a_missing_package_is_named_with_the_line_that_installs_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(
        ImportError, match=re.escape("need zarr, which is not installed: pip install 'covariant[scale]")
    ):
        map_grid(observables, GRID, tmp_path / "map.zarr", **SETTINGS)


def test_another_function_is_not_mixed_into_a_store(tmp_path):
    def stopped(done, total):
        if done:
            raise KeyboardInterrupt

    path = tmp_path / "level.zarr"
    settings: Any = {"grid": GRID, "path": path, "block": BLOCK, "workers": 1, **LEVEL}
    with pytest.raises(KeyboardInterrupt):
        map_grid(lambda x: {"level": 2.0 * x[0]}, on_progress=stopped, **settings)
    begun = chunks(path)
    for other in (lambda x: {"level": 2.1 * x[0]}, lambda x: {"level": 2.0 * x[1]}, lambda x: {"level": x[0] + x[0]}):
        with pytest.raises(ValueError, match="holds another map: what is evaluated at a point was changed"):
            map_grid(other, **settings)
    assert chunks(path) == begun
    map_grid(lambda z: {"level": 2.0 * z[0]}, **settings)  # the same, whatever its names are
    attributes = zarr.open_group(path, mode="r+").attrs
    there = attributes["versions"]
    attributes["versions"] = [there[0] | {"jax": "0.0.1"}]  # such a hash may be another one for the same function
    for _ in range(2):
        map_grid(lambda z: {"level": z[0] + z[0]}, **settings)
