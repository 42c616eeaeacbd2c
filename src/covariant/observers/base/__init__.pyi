from ._covariance import (
    Covariance as Covariance,
    check_covariance as check_covariance,
    covariance_along as covariance_along,
    covariance_at as covariance_at,
    isotropic as isotropic,
)
from ._gate import CREDIBLE as CREDIBLE, Gate as Gate, judged as judged, start as start, with_block as with_block
from ._gate_memory import GateMemory as GateMemory, Judged as Judged, Sample as Sample, Velocity as Velocity
from ._protocol import (
    AbstractFlowObserver as AbstractFlowObserver,
    AbstractMechanicalObserver as AbstractMechanicalObserver,
    AbstractObserver as AbstractObserver,
    AbstractWrapper as AbstractWrapper,
    Rows as Rows,
    aged as aged,
    as_gain as as_gain,
    as_numbers as as_numbers,
    at_rest as at_rest,
    check_finite as check_finite,
    check_free as check_free,
    check_not_negative as check_not_negative,
    check_positive as check_positive,
    check_whole as check_whole,
    checked as checked,
    continuous as continuous,
    in_jax as in_jax,
    kept as kept,
    no_input as no_input,
    outcome as outcome,
    readability as readability,
    run as run,
    scan as scan,
    step_length as step_length,
    still as still,
    time_since_measurement as time_since_measurement,
    uniqueness as uniqueness,
    with_velocity as with_velocity,
)
from ._sampled import (
    acceleration_gain as acceleration_gain,
    chooses_substeps as chooses_substeps,
    needed_substeps as needed_substeps,
    predict as predict,
    predicted as predicted,
    sampled_correction as sampled_correction,
    sampled_force_gains as sampled_force_gains,
    sampled_gains as sampled_gains,
    step_result as step_result,
    steps_for as steps_for,
    with_fixed_substeps as with_fixed_substeps,
)
from ._square_root import (
    diagonal as diagonal,
    normalised_square as normalised_square,
    updated as updated,
    white_acceleration as white_acceleration,
)
from ._states import (
    Diagnostics as Diagnostics,
    Fields as Fields,
    Info as Info,
    LastInput as LastInput,
    MechanicalState as MechanicalState,
    Report as Report,
    SampledState as SampledState,
    State as State,
)
from ._ticks import Encoded as Encoded, Readings as Readings, take as take
