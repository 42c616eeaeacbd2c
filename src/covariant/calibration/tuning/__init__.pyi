from ._constant_gains import Candidate as Candidate
from ._data_sheet import DataSheet as DataSheet, Trial as Trial
from ._estimators import (
    ESTIMATORS as ESTIMATORS,
    STATE_ESTIMATORS as STATE_ESTIMATORS,
    estimators as estimators,
    gated as gated,
    observer_gains as observer_gains,
    tuned_estimators as tuned_estimators,
    tuned_state_estimators as tuned_state_estimators,
    with_gains as with_gains,
)
from ._filters import filter_error as filter_error
from ._gains import (
    Gains as Gains,
    gains as gains,
    predict_errors as predict_errors,
    predict_sampled_errors as predict_sampled_errors,
)
from ._judge import ErrorRatio as ErrorRatio
from ._missing_inputs import missing_inputs as missing_inputs
from ._stored_observer import stored_observer as stored_observer
from ._suggest import Suggestion as Suggestion, suggest_noise as suggest_noise
from ._tune import HeldOut as HeldOut, Tuning as Tuning, tune as tune
