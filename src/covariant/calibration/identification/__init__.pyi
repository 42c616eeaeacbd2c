from ._draft import Draft as Draft, draft as draft
from ._error_model import (
    ErrorModel as ErrorModel,
    Filtered as Filtered,
    NoiseLevels as NoiseLevels,
    error_model as error_model,
    from_later as from_later,
    kalman as kalman,
    smoothed as smoothed,
)
from ._excitation import (
    ExcitationPlan as ExcitationPlan,
    JointLimits as JointLimits,
    design_excitation as design_excitation,
)
from ._expected import ExpectedErrors as ExpectedErrors, Sensing as Sensing
from ._fit import (
    Fit as Fit,
    fit as fit,
    profile as profile,
    relations as relations,
    search as search,
    window_losses as window_losses,
)
from ._fourier import FourierMotion as FourierMotion
from ._predict import (
    PredictionErrors as PredictionErrors,
    error_growth as error_growth,
    errors_ahead as errors_ahead,
    family_errors as family_errors,
    machine_errors as machine_errors,
    mean_square as mean_square,
    predicts_worse as predicts_worse,
    rows_ahead as rows_ahead,
)
from ._rivals import Rival as Rival, better_reading as better_reading
from ._robot_combinations import Combinations as Combinations
from ._robot_fit import RobotFit as RobotFit, fit_robot as fit_robot
from ._robot_misfit import robot_misfit as robot_misfit, standing_still as standing_still
from ._robot_torques import motor_inputs as motor_inputs
from ._servo_excitation import (
    ExpectedOfCommands as ExpectedOfCommands,
    command_excitation as command_excitation,
    motion_periods as motion_periods,
    of_coordinates as of_coordinates,
)
from ._servo_fit import fit_servos as fit_servos
from ._servo_motion import predict_servos as predict_servos
from ._servo_units import DraftedServo as DraftedServo
from ._unknowns import Unknowns as Unknowns
from ._windows import (
    FITTED as FITTED,
    Windows as Windows,
    cut_windows as cut_windows,
    held_out_logs as held_out_logs,
    horizon as horizon,
    split_windows as split_windows,
)
