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
    Solved as Solved,
    again as again,
    block_losses as block_losses,
    fit as fit,
    profile as profile,
    relations as relations,
    search as search,
)
from ._fourier import FourierMotion as FourierMotion
from ._informative import most_informative as most_informative
from ._likelihood import (
    descend as descend,
    levels as levels,
    total_loss as total_loss,
    window_errors as window_errors,
)
from ._predict import (
    PredictionErrors as PredictionErrors,
    error_growth as error_growth,
    mean_square as mean_square,
    predicts_worse as predicts_worse,
    worse_coordinates as worse_coordinates,
)
from ._robot_combinations import Combinations as Combinations
from ._robot_fit import RobotFit as RobotFit, fit_robot as fit_robot
from ._robot_likelihood import (
    RobotUnknowns as RobotUnknowns,
    likeliest_robot as likeliest_robot,
)
from ._robot_misfit import robot_misfit as robot_misfit, standing_still as standing_still
from ._robot_torques import motor_inputs as motor_inputs
from ._rows import (
    FITTED as FITTED,
    MOST_ROWS as MOST_ROWS,
    Rows as Rows,
    gather as gather,
    held_out_logs as held_out_logs,
    held_out_rows as held_out_rows,
    horizon as horizon,
    stretch as stretch,
)
from ._servo_excitation import (
    command_excitation as command_excitation,
    motion_periods as motion_periods,
    of_coordinates as of_coordinates,
)
from ._servo_fit import fit_servos as fit_servos, own_numbers as own_numbers
from ._servo_motion import predict_servos as predict_servos, stick_bands as stick_bands
from ._servo_units import DraftedServo as DraftedServo
from ._states import rows_of as rows_of, unknowns_of as unknowns_of
from ._unknowns import Unknowns as Unknowns
