from ._ekf import EKF as EKF
from ._fixed_lag import FixedLag as FixedLag
from ._flow import apart as apart, parallel as parallel
from ._intrinsic_kalman import IntrinsicKalman as IntrinsicKalman
from ._joint_kalman import JointKalman as JointKalman
from ._legged_base import (
    LeggedBase as LeggedBase,
    LeggedBaseInfo as LeggedBaseInfo,
    LeggedBaseState as LeggedBaseState,
    legged_base as legged_base,
)
from ._riccati import (
    Estimate as Estimate,
    InformationEKF as InformationEKF,
    InformationState as InformationState,
    Riccati as Riccati,
)
from ._smoother import smooth as smooth
from ._state_ekf import StateEKF as StateEKF
from ._state_noise import (
    StateNoise as StateNoise,
    covariance_ekf as covariance_ekf,
    information_ekf as information_ekf,
    riccati as riccati,
)
from ._ukf import UKF as UKF
