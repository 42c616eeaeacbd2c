"""Logs: text, Parquet and messages of ROS are read into a `Record` in SI units, and columns of numbers are written."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
