"""Many cases: whoever computes them, whatever dies on the way."""

import os
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import NamedTuple

import distributed
import pytest

from covariant._cases import CaseTable, Crew, run_chunks


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


@pytest.mark.long
def test_a_chunk_that_kills_its_process_takes_no_other_with_it():
    results = list(run_chunks(Squares(deadly=7), CHUNKS, Crew(2, processes=True)))
    dead = [(chunk, result) for chunk, result in results if isinstance(result, BrokenExecutor)]
    assert [chunk for chunk, _ in dead] == [[6, 7]]
    assert "ran out of memory" in str(dead[0][1]) or "runs out of memory" in str(dead[0][1])
    assert sorted(each for each in results if each not in dead) == [each for each in RIGHT if each[0] != [6, 7]]


@pytest.mark.long
def test_a_worker_of_a_cluster_that_is_killed_loses_nothing(tmp_path):
    """A client is taken as it is, and left open."""
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        assert sorted(run_chunks(Squares(7, str(tmp_path)), CHUNKS, Crew(cluster=client))) == RIGHT
        assert client.submit(int, 3).result() == 3
    assert (tmp_path / "died").exists()


def test_rows_come_back_as_they_were(tmp_path):
    table = CaseTable(tmp_path / "cases")
    table.write({"a": {"nis": 0.1 + 0.2, "wrong": ""}, "b": {"failed": "no rows"}})
    table.write({"c": {"nis": float("inf")}})
    assert table.rows() == {
        "a": {"nis": 0.1 + 0.2, "wrong": ""},
        "b": {"failed": "no rows"},
        "c": {"nis": float("inf")},
    }
