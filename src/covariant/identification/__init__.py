"""Identification: from logs and a rough model to a calibrated one, with standard errors."""

from covariant.identification._draft import Draft, draft
from covariant.identification._fit import Fit, fit
from covariant.identification._held_out import FITTED, growth, split
from covariant.identification._predict import PredictionErrors, prediction_errors
from covariant.identification._relations import relations
from covariant.identification._windows import Windows, horizon, windows

__all__ = [
    "FITTED",
    "Draft",
    "Fit",
    "PredictionErrors",
    "Windows",
    "draft",
    "fit",
    "growth",
    "horizon",
    "prediction_errors",
    "relations",
    "split",
    "windows",
]
