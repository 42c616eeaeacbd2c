"""What `covariant export` was asked for, and what it is going to write."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from covariant.observers import AbstractObserver


class Asked(NamedTuple):
    """The options of the command as the user gave them."""

    observer: str | None
    gains: tuple[float | None, float | None]
    rate: float
    real: str
    name: str | None
    parameters: str | None
    certificate: Path | None
    metric: Path | None
    fmi: str | None
    audited: bool
    overwrite: bool
    flash: str | None


class Planned(NamedTuple):
    """An observer to write: its name, the observer, a sentence on its numbers, and measurements (ROWS + 1, *n) for the
    self-test."""

    kind: str
    observer: AbstractObserver
    design: str
    measured: np.ndarray
