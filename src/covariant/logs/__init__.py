"""Logs: text, Parquet and messages of ROS are read into a `Record` in SI units, and columns of numbers are written."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
