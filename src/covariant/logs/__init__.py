"""Logs on disk: CSV and Parquet files read into a `Record`, and columns of numbers written back, all or nothing."""

from covariant.logs._columns import Columns, Log, LogError
from covariant.logs._read import read
from covariant.logs._write import write

__all__ = ["Columns", "Log", "LogError", "read", "write"]
