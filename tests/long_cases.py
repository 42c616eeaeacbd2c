"""Many cases: whoever computes them, whatever dies on the way: what takes long."""

import contextlib
from concurrent.futures import BrokenExecutor

import dask.config
import distributed
import pytest
from test_cases import CHUNKS, RIGHT, Squares

from covariant._cases import Crew, run_chunks


@pytest.mark.exhaustive
@pytest.mark.parametrize("scheduled", [False, True])
def test_a_part_that_kills_its_process_takes_no_other_with_it(scheduled):
    with contextlib.ExitStack() as stack:
        crew = Crew(2, processes=True)
        if scheduled:
            # Not after the fourth death, to be done sooner.
            stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": 0}))
            cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
            crew = Crew(cluster=stack.enter_context(distributed.Client(stack.enter_context(cluster))))
        results = list(run_chunks(Squares(deadly=7), CHUNKS, crew, lambda chunk: [[number] for number in chunk]))
    dead = [(chunk, result) for chunk, result in results if isinstance(result, BrokenExecutor)]
    assert [chunk for chunk, _ in dead] == [[7]]
    assert "runs out of memory" in str(dead[0][1])
    squares = [pair for each in results if each not in dead for pair in zip(*each, strict=True)]
    assert sorted(squares) == [(number, number**2) for number in range(20) if number != 7]


@pytest.mark.exhaustive
def test_a_worker_of_a_cluster_that_is_killed_loses_nothing(tmp_path):
    """A client is taken as it is, and left open."""
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        assert sorted(run_chunks(Squares(7, str(tmp_path)), CHUNKS, Crew(cluster=client))) == RIGHT
        assert client.submit(int, 3).result() == 3
    assert (tmp_path / "died").exists()
