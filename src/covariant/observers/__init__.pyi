from ._contracting import (
    Contracting as Contracting,
    ContractingState as ContractingState,
    craft_observer as craft_observer,
)
from ._copy import Copy as Copy
from ._damped import (
    Damped as Damped,
    DampedInfo as DampedInfo,
    DampedState as DampedState,
    damping_margin as damping_margin,
)
from ._delayed import Delayed as Delayed, DelayedState as DelayedState
from ._ekf import EKF as EKF, EKFInfo as EKFInfo, EKFState as EKFState
from ._filtered_derivative import FilteredDerivative as FilteredDerivative, FilteredState as FilteredState
from ._fixed_lag import FixedLag as FixedLag, FixedLagState as FixedLagState, FixedLagWindow as FixedLagWindow
from ._gate import Gate as Gate
from ._gate_memory import GateMemory as GateMemory, Judged as Judged, Sample as Sample, Velocity as Velocity
from ._gated import Gated as Gated, GatedState as GatedState
from ._geodesic import Geodesic as Geodesic, GeodesicInfo as GeodesicInfo, GeodesicState as GeodesicState
from ._high_gain import HighGain as HighGain
from ._implicit_distances import (
    DistanceBounds as DistanceBounds,
    DistanceDecay as DistanceDecay,
    distance_decay as distance_decay,
)
from ._implicit_geodesic import ImplicitGeodesic as ImplicitGeodesic
from ._implicit_limits import (
    CurvedErrors as CurvedErrors,
    ImplicitGains as ImplicitGains,
    PartLimits as PartLimits,
    ProvedDecay as ProvedDecay,
    implicit_gains as implicit_gains,
    longest_interval as longest_interval,
    part_limits as part_limits,
    proved_decay as proved_decay,
)
from ._intrinsic import Intrinsic as Intrinsic, second_order as second_order
from ._intrinsic_kalman import IntrinsicKalman as IntrinsicKalman, KalmanInfo as KalmanInfo, KalmanState as KalmanState
from ._joint_kalman import JointInfo as JointInfo, JointKalman as JointKalman, JointState as JointState
from ._least_gain import ContinuousGains as ContinuousGains, least_gain as least_gain
from ._levant import Levant as Levant
from ._model_free import AbstractLinearFilter as AbstractLinearFilter, FilterInfo as FilterInfo
from ._momentum import (
    AbstractForceObserver as AbstractForceObserver,
    ForceState as ForceState,
    InverseDynamics as InverseDynamics,
    MomentumObserver as MomentumObserver,
    observed_forces as observed_forces,
)
from ._names import (
    OBSERVER_NAMES as OBSERVER_NAMES,
    SMOOTHED as SMOOTHED,
    STATE_OBSERVER_NAMES as STATE_OBSERVER_NAMES,
)
from ._noise_step import NoiseStep as NoiseStep, noise_step as noise_step
from ._passive_ship import (
    PassiveGains as PassiveGains,
    PassiveShip as PassiveShip,
    lyapunov_gains as lyapunov_gains,
    lyapunov_rate as lyapunov_rate,
    notch_gains as notch_gains,
    printed_rate as printed_rate,
)
from ._pll import PLL as PLL
from ._protocol import (
    AbstractFlowObserver as AbstractFlowObserver,
    AbstractMechanicalObserver as AbstractMechanicalObserver,
    AbstractObserver as AbstractObserver,
    AbstractWrapper as AbstractWrapper,
    Info as Info,
    MechanicalState as MechanicalState,
    SampledState as SampledState,
    checked as checked,
    continuous as continuous,
    run as run,
)
from ._reduced_order import ReducedOrder as ReducedOrder, ReducedOrderState as ReducedOrderState
from ._registry import REGISTRY as REGISTRY, Entry as Entry
from ._riccati import (
    Estimate as Estimate,
    InformationEKF as InformationEKF,
    InformationState as InformationState,
    Riccati as Riccati,
)
from ._salcudean import Salcudean as Salcudean, SalcudeanState as SalcudeanState
from ._sampled import (
    chooses_substeps as chooses_substeps,
    needed_substeps as needed_substeps,
    with_fixed_substeps as with_fixed_substeps,
)
from ._savitzky_golay import SavitzkyGolay as SavitzkyGolay, WindowState as WindowState
from ._sensor_kinds import (
    accelerometer as accelerometer,
    encoder as encoder,
    gyro as gyro,
    point_sensor as point_sensor,
    pose_sensor as pose_sensor,
    tachometer as tachometer,
)
from ._sensors import Instant as Instant, Sensor as Sensor, SensorInfo as SensorInfo
from ._slow import (
    Slow as Slow,
    external_force as external_force,
    sensor_bias as sensor_bias,
    uncertain_parameters as uncertain_parameters,
)
from ._smoother import Smoothed as Smoothed, smooth as smooth
from ._state_ekf import StateEKF as StateEKF, StateEKFInfo as StateEKFInfo, StateEKFState as StateEKFState
from ._state_noise import Noise as Noise
from ._tracking_loop import LoopState as LoopState
from ._ukf import UKF as UKF, UKFState as UKFState
from ._wrench import wrench as wrench
