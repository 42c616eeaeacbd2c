"""Calibration: diagnosis of logs, identification of model parameters, and tuning of noise and gains from logs."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
