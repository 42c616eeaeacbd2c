"""Calibration: diagnosis of logs, identification of model parameters, and tuning of noise and gains from logs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
