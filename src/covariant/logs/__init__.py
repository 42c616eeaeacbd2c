"""Reads logs (text, Parquet, ROS messages) into a `Record` in SI units, and writes columns of numbers."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
