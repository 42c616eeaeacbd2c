from ._ekf import EKF as EKF, EKFInfo as EKFInfo, EKFState as EKFState
from ._fixed_lag import FixedLag as FixedLag, FixedLagState as FixedLagState, FixedLagWindow as FixedLagWindow
from ._flow import apart as apart, parallel as parallel
from ._intrinsic_kalman import (
    IntrinsicKalman as IntrinsicKalman,
    KalmanInfo as KalmanInfo,
    KalmanState as KalmanState,
)
from ._joint_kalman import JointInfo as JointInfo, JointKalman as JointKalman, JointState as JointState
from ._legged_base import (
    LeggedBase as LeggedBase,
    LeggedBaseInfo as LeggedBaseInfo,
    LeggedBaseState as LeggedBaseState,
    legged_base as legged_base,
)
from ._noise_step import NoiseStep as NoiseStep, noise_step as noise_step
from ._riccati import (
    Estimate as Estimate,
    InformationEKF as InformationEKF,
    InformationState as InformationState,
    Riccati as Riccati,
)
from ._smoother import Smoothed as Smoothed, smooth as smooth
from ._state_ekf import StateEKF as StateEKF, StateEKFInfo as StateEKFInfo, StateEKFState as StateEKFState
from ._state_noise import (
    StateNoise as StateNoise,
    covariance_ekf as covariance_ekf,
    information_ekf as information_ekf,
    riccati as riccati,
)
from ._ukf import UKF as UKF, UKFState as UKFState
