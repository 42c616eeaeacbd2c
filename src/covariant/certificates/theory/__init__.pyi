from ._cascade import (
    CascadeCertificate as CascadeCertificate,
    Constants as Constants,
    Growth as Growth,
    cascade as cascade,
)
from ._corners import Corners as Corners, at_corners as at_corners
from ._distance import (
    Decay as Decay,
    decay as decay,
    lower_distance as lower_distance,
    upper_distance as upper_distance,
)
from ._distance_certificate import (
    DistanceCertificate as DistanceCertificate,
    certify_distance as certify_distance,
    compare_connections as compare_connections,
)
from ._dwell_time import JumpGrowth as JumpGrowth, dwell_time as dwell_time, jump_growth as jump_growth
from ._falsify import falsify as falsify
from ._implicit_distances import (
    DistanceBounds as DistanceBounds,
    DistanceDecay as DistanceDecay,
    distance_decay as distance_decay,
)
from ._implicit_limits import (
    longest_interval as longest_interval,
    part_limits as part_limits,
)
from ._lifted_metric import LiftedGain as LiftedGain, least_gain as least_gain, lifted_gain as lifted_gain
from ._lmi import (
    MetricDesign as MetricDesign,
    common_metric as common_metric,
    minimise as minimise,
    observer_gain as observer_gain,
)
from ._marine_cascade import crossed_metric as crossed_metric, feedthrough as feedthrough, tracking as tracking
from ._observability import (
    Observability as Observability,
    bending as bending,
    detectability_rate as detectability_rate,
    observability as observability,
)
from ._reduced_order import ReducedOrderDesign as ReducedOrderDesign, reduced_order as reduced_order
from ._virtual import virtual as virtual
