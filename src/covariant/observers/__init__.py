"""Observers: each in a file of its own, and the baselines they are compared with, all in one form."""

from covariant.observers._contracting import Contracting, ContractingState, craft_observer
from covariant.observers._copy import Copy
from covariant.observers._delayed import Delayed, DelayedState
from covariant.observers._ekf import EKF, EKFInfo, EKFState
from covariant.observers._filtered_derivative import FilteredDerivative, FilteredState
from covariant.observers._gate import Gate
from covariant.observers._gated import Gated, GatedState
from covariant.observers._geodesic import Geodesic, GeodesicInfo, GeodesicState
from covariant.observers._high_gain import HighGain
from covariant.observers._intrinsic import Intrinsic, second_order
from covariant.observers._intrinsic_kalman import IntrinsicKalman, KalmanInfo, KalmanState
from covariant.observers._joint_kalman import JointInfo, JointKalman, JointState
from covariant.observers._levant import Levant
from covariant.observers._model_free import AbstractLinearFilter, FilterInfo
from covariant.observers._passive_ship import (
    PassiveGains,
    PassiveShip,
    lyapunov_gains,
    lyapunov_rate,
    notch_gains,
    printed_rate,
)
from covariant.observers._pll import PLL
from covariant.observers._protocol import (
    AbstractFlowObserver,
    AbstractMechanicalObserver,
    AbstractObserver,
    HeldState,
    Info,
    MechanicalState,
    continuous,
    run,
)
from covariant.observers._registry import REGISTRY, Entry
from covariant.observers._riccati import Estimate, InformationEKF, InformationState, Riccati
from covariant.observers._salcudean import Salcudean, SalcudeanState
from covariant.observers._sampled import chooses_substeps, needed_substeps, with_fixed_substeps
from covariant.observers._savitzky_golay import SavitzkyGolay, WindowState
from covariant.observers._slow import Slow, external_force, sensor_bias, uncertain_parameters
from covariant.observers._state_ekf import StateEKF, StateEKFInfo, StateEKFState
from covariant.observers._state_registry import STATE_REGISTRY, Noise, StateEntry
from covariant.observers._tracking_loop import LoopState
from covariant.observers._ukf import UKF, UKFState

__all__ = [
    "EKF",
    "PLL",
    "REGISTRY",
    "STATE_REGISTRY",
    "UKF",
    "AbstractFlowObserver",
    "AbstractLinearFilter",
    "AbstractMechanicalObserver",
    "AbstractObserver",
    "Contracting",
    "ContractingState",
    "Copy",
    "Delayed",
    "DelayedState",
    "EKFInfo",
    "EKFState",
    "Entry",
    "Estimate",
    "FilterInfo",
    "FilteredDerivative",
    "FilteredState",
    "Gate",
    "Gated",
    "GatedState",
    "Geodesic",
    "GeodesicInfo",
    "GeodesicState",
    "HeldState",
    "HighGain",
    "Info",
    "InformationEKF",
    "InformationState",
    "Intrinsic",
    "IntrinsicKalman",
    "JointInfo",
    "JointKalman",
    "JointState",
    "KalmanInfo",
    "KalmanState",
    "Levant",
    "LoopState",
    "MechanicalState",
    "Noise",
    "PassiveGains",
    "PassiveShip",
    "Riccati",
    "Salcudean",
    "SalcudeanState",
    "SavitzkyGolay",
    "Slow",
    "StateEKF",
    "StateEKFInfo",
    "StateEKFState",
    "StateEntry",
    "UKFState",
    "WindowState",
    "chooses_substeps",
    "continuous",
    "craft_observer",
    "external_force",
    "lyapunov_gains",
    "lyapunov_rate",
    "needed_substeps",
    "notch_gains",
    "printed_rate",
    "run",
    "second_order",
    "sensor_bias",
    "uncertain_parameters",
    "with_fixed_substeps",
]
