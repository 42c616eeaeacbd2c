"""Chooses the engine that runs an observer, compiled C or JAX; no other module makes this choice."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np

from covariant.engine._compile import missing
from covariant.engine._kernel import Kernel, KernelForm, NoKernelError, prepared
from covariant.engine._numbers import open_numbers
from covariant.observers import AbstractObserver
from scalargraph.cache import cache_folder
from scalargraph.errors import InputError

EngineName = Literal["auto", "c", "jax"]
FEWEST_ROWS = 100_000
"""Number of rows from which compiling C pays, even if the compiled observer cannot be cached."""


class Engine(NamedTuple):
    """The engine that runs an observer; as text "c", or "jax: " with the reason.

    Attributes:
        name: "c" or "jax".
        reason: One line that explains the choice.
        kernel: The compiled observer if the engine is C, otherwise None.
        refused: Whether compilation in C was tried and failed.

    Example:
        >>> from covariant import engine, observers
        >>> from covariant.engine._kernel import KernelForm
        >>> form = KernelForm((2,), 0)
        >>> chosen = engine.choose(observers.FilteredDerivative(50.0), form, 1000, "jax")
        >>> chosen.name, str(chosen)
        ('jax', 'jax: as asked')
    """

    name: Literal["c", "jax"]
    reason: str
    kernel: Kernel | None = None
    refused: bool = False

    def __str__(self) -> str:
        return self.name if self.kernel is not None else f"{self.name}: {self.reason}"


def choose(observer: AbstractObserver, form: KernelForm, rows: int | float, asked: EngineName = "auto") -> Engine:
    """Choose the engine that runs an observer: compiled C if that is possible and pays, otherwise JAX.

    C needs a compiler that accepts the generated text, the package `cffi`, and an observer that is a graph of scalars.
    With "auto" the compilation must also pay: the compiled observer can be cached for later processes, or there are at
    least `FEWEST_ROWS` rows. Both engines compute in double precision and agree up to rounding.

    Args:
        observer: Any observer.
        form: Shape of its measurements, number of its inputs, which of its arrays are arguments, and number of lanes.
        rows: Number of rows it will run over, all runs together; infinite for a stream.
        asked: "c" and "auto" use C if possible, "jax" never does.

    Returns:
        The engine, with the reason if it is JAX.

    Raises:
        ValueError: The engine is unknown.

    Example:
        >>> from covariant import engine, observers
        >>> from covariant.engine._kernel import KernelForm
        >>> engine.choose(observers.FilteredDerivative(50.0), KernelForm((2,), 0), 10, "jax").reason
        'as asked'
    """
    if asked not in get_args(EngineName):
        raise InputError(f"engine must be one of {', '.join(get_args(EngineName))}; got {asked!r}")
    if asked == "jax":
        return Engine("jax", "as asked")
    lacking = missing()
    if lacking is not None:
        return Engine("jax", lacking)
    if not form.real:
        return Engine("jax", "measurements are complex numbers")
    pays = asked == "c" or rows >= FEWEST_ROWS
    uncached = Engine("jax", f"fewer than {FEWEST_ROWS} rows, and compiled C would not be kept")
    # This is checked before tracing, which takes long for a robot.
    if not pays and cache_folder() is None:
        return uncached
    traced = prepared(observer, form)
    # An observer without a key cannot be cached for later processes.
    if not pays and traced.key is None:
        return uncached
    try:
        return Engine("c", "as asked" if asked == "c" else "many rows" if pays else "it is kept", traced.kernel)
    except NoKernelError as error:
        return Engine("jax", str(error), refused=True)


def choose_open(
    observers: Sequence[AbstractObserver], form: KernelForm, rows: int | float, asked: EngineName = "auto"
) -> tuple[Engine, np.ndarray]:
    """Choose the engine for observers of one kind, whose numbers are arguments of the compiled code if possible.

    This is impossible, for example, if numbers of the model decide which entries of an array it reads. Then numbers of
    the model that all observers share are constants of the code.
    """
    opened = open_numbers(observers)
    chosen = choose(observers[0], form._replace(opened=opened.places), rows, asked)
    if chosen.refused:
        opened = open_numbers(observers, models=False)
        chosen = choose(observers[0], form._replace(opened=opened.places), rows, asked)
    return chosen, opened.values
