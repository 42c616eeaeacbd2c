from ._missing_inputs import InputStates as InputStates, MissingInputs as MissingInputs, missing_now as missing_now
from ._momentum import MomentumObserver as MomentumObserver, observed_forces as observed_forces
from ._presliding import presliding_friction as presliding_friction
from ._sensor_kinds import (
    SENSOR_KINDS as SENSOR_KINDS,
    AbstractSensorKind as AbstractSensorKind,
    Checks as Checks,
    accelerometer as accelerometer,
    encoder as encoder,
    gyro as gyro,
    point_sensor as point_sensor,
    pose_sensor as pose_sensor,
    tachometer as tachometer,
)
from ._sensors import (
    Instant as Instant,
    Readings as Readings,
    Sensed as Sensed,
    Sensor as Sensor,
    SensorInfo as SensorInfo,
    Sensors as Sensors,
)
from ._slow import (
    SlowStates as SlowStates,
    SlowVariables as SlowVariables,
    SlowVector as SlowVector,
    as_groups as as_groups,
    external_force as external_force,
    sensor_bias as sensor_bias,
    uncertain_parameters as uncertain_parameters,
)
from ._wrench import wrench as wrench
