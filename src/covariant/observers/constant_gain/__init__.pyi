from ._contracting import Contracting as Contracting, craft_observer as craft_observer
from ._copy import ModelCopy as ModelCopy
from ._geodesic import Geodesic as Geodesic, GeodesicInfo as GeodesicInfo, GeodesicState as GeodesicState
from ._intrinsic import Intrinsic as Intrinsic, second_order as second_order
from ._intrinsic_force import IntrinsicForce as IntrinsicForce, IntrinsicForceState as IntrinsicForceState
from ._lagrangian_metric import LagrangianMetric as LagrangianMetric
from ._measured_coefficients import MeasuredCoefficients as MeasuredCoefficients
from ._passive_ship import (
    PassiveShip as PassiveShip,
    lyapunov_gains as lyapunov_gains,
    lyapunov_rate as lyapunov_rate,
    notch_gains as notch_gains,
    printed_rate as printed_rate,
)
from ._salcudean import Salcudean as Salcudean, of_mean_inertia as of_mean_inertia
