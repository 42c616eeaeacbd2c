"""Which engine runs an observer: compiled C or JAX. Nothing else in the library chooses between them."""

from typing import Literal, NamedTuple, get_args

from covariant._programs import cache_folder
from covariant.engine._compile import missing
from covariant.engine._kernel import Kernel, KernelForm, NoKernelError, prepared
from covariant.observers import AbstractObserver

EngineName = Literal["auto", "c", "jax"]
FEWEST_ROWS = 100_000
"""Fewest rows for which C is worth its compilation although nothing is kept of it."""


class Engine(NamedTuple):
    """What computes, and why in one line; as text "c", or "jax" with the reason.

    - `kernel`: the compiled observer where the engine is C.
    """

    name: Literal["c", "jax"]
    reason: str
    kernel: Kernel | None = None

    def __str__(self) -> str:
        return self.name if self.kernel is not None else f"{self.name}: {self.reason}"


def choose(observer: AbstractObserver, form: KernelForm, rows: int | float, asked: EngineName = "auto") -> Engine:
    """The engine for an observer.

    - `form`: the shape of its measurements, its inputs, which of its arrays are arguments, and the lanes.
    - `rows`: how many rows it will run over, all runs together; infinite for a stream.
    - `asked`: "c" and "auto" take C where they can, "jax" never does.

    The rule: C, where there is a compiler and `cffi`, where the observer has a graph of scalars and the compiler takes
    its text, and, for "auto", where the compilation pays: the compiled observer is kept for later processes, or there
    are `FEWEST_ROWS` rows. JAX otherwise. Both compute in double precision and give the same to rounding. Raises
    `ValueError` for an unknown engine.
    """
    if asked not in get_args(EngineName):
        raise ValueError(f"engine must be one of {', '.join(get_args(EngineName))}; got {asked!r}")
    if asked == "jax":
        return Engine("jax", "as asked")
    lacking = missing()
    if lacking is not None:
        return Engine("jax", lacking)
    if not form.real:
        return Engine("jax", "measurements are complex numbers")
    pays = asked == "c" or rows >= FEWEST_ROWS
    short = Engine("jax", f"fewer than {FEWEST_ROWS} rows, and compiled C would not be kept")
    if not pays and cache_folder() is None:
        return short
    traced = prepared(observer, form)
    if not pays and traced.key is None:
        return short
    try:
        return Engine("c", "as asked" if asked == "c" else "many rows" if pays else "it is kept", traced.kernel)
    except NoKernelError as error:
        return Engine("jax", str(error))
