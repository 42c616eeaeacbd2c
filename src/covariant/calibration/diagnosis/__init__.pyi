from ._case import (
    best_window as best_window,
    busiest as busiest,
    case_without_outliers as case_without_outliers,
    changed as changed,
    clearly as clearly,
    in_coordinates as in_coordinates,
)
from ._changes import unit_changes as unit_changes
from ._clock import mended_clock as mended_clock
from ._diagnose import (
    BARELY as BARELY,
    FEW_ROWS as FEW_ROWS,
    MARGIN as MARGIN,
    MOST_ROWS as MOST_ROWS,
    diagnose as diagnose,
    misfit as misfit,
)
from ._finding import Diagnosis as Diagnosis, Finding as Finding
from ._readings import one_or_each as one_or_each, readings as readings, written as written
from ._sensor import outliers as outliers, still_findings as still_findings
from ._sensor_findings import standstill as standstill
from ._sensor_motion import Beside as Beside
from ._smooth import (
    Smooth as Smooth,
    acceleration_kernel as acceleration_kernel,
    held_inputs as held_inputs,
    second_derivative_weights as second_derivative_weights,
)
from ._speeds import usual_speeds as usual_speeds
