"""Diagnosis of a log: what is wrong with it, or with the model for it, before anybody estimates from it."""

from covariant.diagnosis._diagnose import diagnose, misfit
from covariant.diagnosis._finding import Diagnosis, Finding
from covariant.diagnosis._sensor import outliers

__all__ = ["Diagnosis", "Finding", "diagnose", "misfit", "outliers"]
