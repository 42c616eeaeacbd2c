from ._ahead import errors_ahead as errors_ahead, rows_ahead as rows_ahead
from ._clock import mended_clock as mended_clock
from ._constant_gains import Candidate as Candidate
from ._contracting import contracting_gain as contracting_gain
from ._data_sheet import DataSheet as DataSheet, Trial as Trial
from ._diagnose import diagnose as diagnose, misfit as misfit
from ._draft import Draft as Draft, draft as draft
from ._error_model import NoiseLevels as NoiseLevels
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
from ._excitation import (
    Excitation as Excitation,
    ExcitationPlan as ExcitationPlan,
    JointLimits as JointLimits,
    design_excitation as design_excitation,
)
from ._expected import ExpectedErrors as ExpectedErrors, Sensing as Sensing
from ._filters import (
    filter_bandwidth as filter_bandwidth,
    jerk_bound as jerk_bound,
    joint_noise as joint_noise,
    window_length as window_length,
)
from ._finding import Diagnosis as Diagnosis, Finding as Finding
from ._fit import Fit as Fit, fit as fit, losses as losses
from ._fourier import FourierMotion as FourierMotion
from ._gains import (
    Gains as Gains,
    bias as bias,
    gains as gains,
    predict_errors as predict_errors,
    predict_sampled_errors as predict_sampled_errors,
)
from ._held_out import FITTED as FITTED, growth as growth, held_out_logs as held_out_logs, split as split
from ._predict import PredictionErrors as PredictionErrors, prediction_errors as prediction_errors
from ._relations import relations as relations
from ._robot_combinations import Combinations as Combinations
from ._robot_fit import RobotFit as RobotFit, fit_robot as fit_robot
from ._robot_misfit import robot_misfit as robot_misfit
from ._robot_torques import motor_inputs as motor_inputs
from ._sensor import outliers as outliers
from ._sensor_motion import Beside as Beside
from ._speeds import usual_speeds as usual_speeds
from ._stored_observer import stored_observer as stored_observer
from ._suggest import Suggestion as Suggestion, suggest_noise as suggest_noise
from ._tune import HeldOut as HeldOut, Tuning as Tuning, given_noise as given_noise, tune as tune
from ._windows import Windows as Windows, horizon as horizon, windows as windows
