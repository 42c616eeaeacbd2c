from ._case import (
    Case as Case,
    best_window as best_window,
    busiest as busiest,
    case_without_outliers as case_without_outliers,
    clearly as clearly,
    in_coordinates as in_coordinates,
    names_of as names_of,
)
from ._clock import mended_clock as mended_clock
from ._columns import units as units
from ._diagnose import diagnose as diagnose
from ._finding import Diagnosis as Diagnosis, Finding as Finding, later_line as later_line
from ._jumps import periods as periods
from ._misfit import misfit as misfit
from ._misread import misread_input as misread_input
from ._readings import (
    ROUNDING as ROUNDING,
    one_or_each as one_or_each,
    outliers as outliers,
    readings as readings,
    still_findings as still_findings,
    usual_speeds as usual_speeds,
    written as written,
)
from ._sensor_findings import standstill as standstill
from ._sensor_motion import Beside as Beside
from ._smooth import (
    Smooth as Smooth,
    acceleration_kernel as acceleration_kernel,
    derivative_weights as derivative_weights,
    held_inputs as held_inputs,
)
from ._suspicion import BLOCKS as BLOCKS, Unexplained as Unexplained, judge as judge
from ._thresholds import BARELY as BARELY, FEW_ROWS as FEW_ROWS, MOST_ROWS as MOST_ROWS
