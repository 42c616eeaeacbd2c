"""Log files: CSV and Parquet files are read into a `Record`, and columns of numbers are written, as complete files."""

from covariant.logs._columns import ATTITUDES, Columns, Log, LogError
from covariant.logs._configuration import Body, bodies, coordinates, matrices, to_columns
from covariant.logs._read import read, survey
from covariant.logs._write import write

__all__ = [
    "ATTITUDES",
    "Body",
    "Columns",
    "Log",
    "LogError",
    "bodies",
    "coordinates",
    "matrices",
    "read",
    "survey",
    "to_columns",
    "write",
]
