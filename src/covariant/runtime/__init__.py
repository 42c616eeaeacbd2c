"""Observers as they run: samples one by one as a stream, and whole logs, by compiled C where there is a compiler."""

from covariant.runtime._log import run_log


__all__ = ["run_log"]
