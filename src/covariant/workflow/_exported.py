"""The observer that `export` writes."""

from typing import NamedTuple

import numpy as np

from covariant.observers import AbstractObserver


class Exported(NamedTuple):
    """Observer to write as code.

    Attributes:
        name: Name of the observer.
        observer: The observer.
        design: A sentence on its numbers.
        measured: Measurements (ROWS + 1, *n) for the self-test.
    """

    name: str
    observer: AbstractObserver
    design: str
    measured: np.ndarray
