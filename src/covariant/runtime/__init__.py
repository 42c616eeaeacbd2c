"""Observers as they run: samples one by one as a stream, and whole logs, by compiled C where there is a compiler."""

from covariant.runtime._log import FEWEST_ROWS, run_log
from covariant.runtime._stream import Health, Stream

__all__ = ["FEWEST_ROWS", "Health", "Stream", "run_log"]
