"""Names for the help of the commands, known here so that help does not load the modules that define them."""

from typing import Literal

from covariant.observers import (
    OBSERVER_NAMES as ESTIMATORS,
    SMOOTHED as SMOOTHED,
    STATE_OBSERVER_NAMES as STATE_ESTIMATORS,
)

__all__ = [
    "CERTIFIED",
    "ESTIMATORS",
    "FIGURES",
    "PAPERS",
    "SMOOTHED",
    "STATE_ESTIMATORS",
    "TABLES",
    "WRITTEN",
    "Checker",
    "Engine",
]

CERTIFIED = ("intrinsic", "geodesic")
"""Observers that can be certified."""
PAPERS = ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen")
"""Papers whose numbers are reproduced."""
Engine = Literal["auto", "c", "jax"]
"""Names of engines, as in `covariant.engine`."""
Checker = Literal["auto", "all", "off"]
"""How much is given to the checker, as in `covariant.certificates`."""
FIGURES = (".png", ".pdf", ".svg")
"""Suffixes of figures."""
TABLES = (".csv", ".txt", ".tsv", ".parquet")
"""Suffixes of tables that are no log."""
WRITTEN = (*TABLES, ".mcap", ".rosbag2")
"""Suffixes of logs that can be written, as in `covariant.logs`."""
