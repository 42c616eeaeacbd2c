"""Logs: text, Parquet and messages of ROS are read into a `Record` in SI units, and columns of numbers are written."""

from covariant.logs._columns import ATTITUDES, Columns, Log, LogError
from covariant.logs._configuration import Body, bodies, coordinates, matrices, to_columns
from covariant.logs._read import OPTIONAL, read, survey
from covariant.logs._units import check_unit, unit_factor
from covariant.logs._write import MESSAGES, WRITTEN, write

__all__ = [
    "ATTITUDES",
    "MESSAGES",
    "OPTIONAL",
    "WRITTEN",
    "Body",
    "Columns",
    "Log",
    "LogError",
    "bodies",
    "check_unit",
    "coordinates",
    "matrices",
    "read",
    "survey",
    "to_columns",
    "unit_factor",
    "write",
]
