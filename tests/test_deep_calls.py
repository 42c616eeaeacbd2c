"""Calls that go deep cost no more than others: the system is not asked for memory at each of them."""

import resource
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from _pytest import runner

from covariant._deep_calls import call_deep

CALLS = 2000
DEEP = 300  # a piece of Python's holds some 120 of these frames


def called(a=0, b=0, c=0, d=0, e=0, f=0, g=0, h=0):
    """Its frame is larger than that of `pages`, so that at some depth it begins a new piece."""


def pages(depth: int) -> int:
    """Pages that the system cleared for a loop of calls that many frames below this one."""
    if depth:
        return pages(depth - 1)
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
    for _ in range(CALLS):
        called()
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before


def most_pages() -> int:
    return max(map(pages, range(DEEP)))


@pytest.mark.skipif(sys.platform != "linux", reason="pages are counted by Linux")
def test_a_loop_at_any_depth_asks_the_system_for_nothing():
    with ThreadPoolExecutor(1) as a_stack_of_its_own:
        assert a_stack_of_its_own.submit(call_deep, most_pages).result() < CALLS / 10


def test_arguments_are_passed_on():
    assert call_deep(divmod, 7, 2) == (3, 1)
    assert call_deep(sorted, [1, 3, 2], reverse=True) == [3, 2, 1]


def test_errors_come_through():
    with pytest.raises(ZeroDivisionError):
        call_deep(divmod, 1, 0)


def test_every_test_runs_like_that():
    frame, functions = sys._getframe(), []
    while frame is not None:
        functions.append(frame.f_code)
        frame = frame.f_back
    assert functions.index(call_deep.__code__) > functions.index(runner.runtestprotocol.__code__)
