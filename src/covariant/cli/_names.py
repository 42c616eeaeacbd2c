"""Names for the help of the commands, known here so that help does not load the modules that define them."""

from typing import Literal

from covariant.observers import OBSERVER_NAMES as ESTIMATORS, STATE_OBSERVER_NAMES as STATE_ESTIMATORS

__all__ = ["CERTIFIED", "ESTIMATORS", "PAPERS", "STATE_ESTIMATORS", "WRITTEN", "Checker", "Engine"]

CERTIFIED = ("intrinsic", "geodesic")
"""The observers that there are certificates for."""
PAPERS = ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen")
"""The papers that are reproduced."""
Engine = Literal["auto", "c", "jax"]
"""Those of `covariant.engine`."""
Checker = Literal["auto", "all", "off"]
"""Those of `covariant.certificates`."""
WRITTEN = (".csv", ".txt", ".tsv", ".parquet", ".mcap", ".rosbag2")
"""Those of `covariant.logs`."""
