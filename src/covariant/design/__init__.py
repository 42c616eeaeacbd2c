"""Design of observers: gains from the numbers of a data sheet, and contraction metrics from a model."""

from covariant.design._contracting import contracting_gain
from covariant.design._data_sheet import DataSheet, Trial
from covariant.design._error_model import NoiseLevels
from covariant.design._estimators import (
    ESTIMATORS,
    STATE_ESTIMATORS,
    estimators,
    gated,
    observer_gains,
    tuned_estimators,
    tuned_state_estimators,
    with_gains,
)
from covariant.design._filters import filter_bandwidth, jerk_bound, joint_noise, window_length
from covariant.design._gains import Gains, bias, gains, predict_errors, predict_sampled_errors
from covariant.design._metric import MetricSummary, load_metric, metric, metric_summary
from covariant.design._speeds import usual_speeds
from covariant.design._tune import HeldOut, Tuning, given_noise, tune

__all__ = [
    "ESTIMATORS",
    "STATE_ESTIMATORS",
    "DataSheet",
    "Gains",
    "HeldOut",
    "MetricSummary",
    "NoiseLevels",
    "Trial",
    "Tuning",
    "bias",
    "contracting_gain",
    "estimators",
    "filter_bandwidth",
    "gains",
    "gated",
    "given_noise",
    "jerk_bound",
    "joint_noise",
    "load_metric",
    "metric",
    "metric_summary",
    "observer_gains",
    "predict_errors",
    "predict_sampled_errors",
    "tune",
    "tuned_estimators",
    "tuned_state_estimators",
    "usual_speeds",
    "window_length",
    "with_gains",
]
