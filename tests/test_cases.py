"""Many cases: whoever computes them, whatever dies on the way."""

import os
import time
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import NamedTuple

import pytest

from covariant._cases import CaseTable, Crew, run_chunks
from covariant.metrics import Grid, Variable, map_grid


class Squares(NamedTuple):
    """Squares of numbers; a process that computes `deadly` dies, where there is a folder only the first time."""

    deadly: int = -1
    once: str = ""

    def __call__(self):
        return self.compute

    def compute(self, chunk):
        if self.deadly in chunk and not (self.once and (Path(self.once) / "died").exists()):
            if self.once:
                (Path(self.once) / "died").touch()
            os._exit(1)
        return [number**2 for number in chunk]


CHUNKS = [[k, k + 1] for k in range(0, 20, 2)]
RIGHT = [(chunk, [number**2 for number in chunk]) for chunk in CHUNKS]


def test_threads_compute_all_and_raise_what_the_function_raises():
    assert sorted(run_chunks(Squares(), CHUNKS, Crew(3))) == RIGHT
    with pytest.raises(TypeError, match="unsupported operand"):
        list(run_chunks(Squares(), [["a"]], Crew(1)))


def test_rows_come_back_as_they_were(tmp_path):
    table = CaseTable(tmp_path / "cases")
    table.write({"a": {"nis": 0.1 + 0.2, "wrong": ""}, "b": {"failed": "no rows"}})
    table.write({"c": {"nis": float("inf")}})
    assert table.rows() == {
        "a": {"nis": 0.1 + 0.2, "wrong": ""},
        "b": {"failed": "no rows"},
        "c": {"nis": float("inf")},
    }


def test_the_newest_row_of_a_case_counts(tmp_path):
    """Whatever the names of the files: they are hashes."""
    for others in range(6):
        table = CaseTable(tmp_path / str(others))
        for age, value in ((100, "old"), (0, "new")):
            table.write({"case": {"value": value}} | {f"{value}{k}": {} for k in range(others)})
            for part in table.folder.glob("*.rows"):
                if age:
                    os.utime(part, (time.time() - age, time.time() - age))
        assert table.rows()["case"] == {"value": "new"}


def test_a_grid_whose_block_kills_its_worker_is_not_complete(tmp_path, monkeypatch):
    def killed(work, chunks, crew):
        yield from ((chunk, BrokenExecutor("its process died")) for chunk in chunks)

    monkeypatch.setattr("covariant.metrics._map.run_chunks", killed)
    grid = Grid(("x",), ("1",), low=(0.0,), high=(1.0,), counts=(8,))
    variables = {"square": Variable((), "1", "a square")}
    with pytest.raises(BrokenExecutor, match="its process died"):
        map_grid(
            lambda x: {"square": x[0] ** 2}, grid, tmp_path / "a.zarr", variables=variables, provenance={}, block=2
        )
