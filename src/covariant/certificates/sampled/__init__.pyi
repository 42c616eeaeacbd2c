from ._prediction import (
    Prediction as Prediction,
    defect_bound as defect_bound,
    defect_matrix as defect_matrix,
    step_values as step_values,
)
from ._sampled_bound import (
    ROUND as ROUND,
    Bounded as Bounded,
    BoundedInfo as BoundedInfo,
    BoundedState as BoundedState,
    Premise as Premise,
    SampledBound as SampledBound,
)
from ._sampled_claims import (
    LOST as LOST,
    LostRows as LostRows,
    check_interval as check_interval,
    check_sampling as check_sampling,
    force_claim as force_claim,
    missing_claims as missing_claims,
    prediction_claims as prediction_claims,
    sampled_claims as sampled_claims,
)
from ._sampled_step import sampled_prediction as sampled_prediction, sampled_system as sampled_system
