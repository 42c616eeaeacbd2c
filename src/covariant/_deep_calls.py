"""Calls that go deep, without the system at each of them.

From 3.11 on, Python allots the frames of its functions in pieces of 16 KiB, and gives the last piece back to the system
as soon as it is empty. Where a loop calls a function across the end of a piece, every call costs two calls of the
system and a page to be cleared. JAX calls deep and often when it traces a function: a fifth of its time went there.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

PLACES = 2**19
"""Values that a frame claims to need, 4 MiB. Its piece is then one of 8 MiB, whose rest holds all that it calls.

Memory that is claimed and never touched is none that the system has to give.
"""


def call_deep(function: Callable[Given, Answer], *args: Given.args, **kwargs: Given.kwargs) -> Answer:
    """`function(*args, **kwargs)`, with one large piece of memory for its frame and those of all that it calls."""
    return function(*args, **kwargs)


call_deep.__code__ = call_deep.__code__.replace(co_stacksize=PLACES)
