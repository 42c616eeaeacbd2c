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
from ._falsify import falsify as falsify
from ._lmi import (
    MetricDesign as MetricDesign,
    common_metric as common_metric,
    is_definite as is_definite,
    minimise as minimise,
    observer_gain as observer_gain,
    rational as rational,
)
from ._marine_cascade import crossed_metric as crossed_metric, feedthrough as feedthrough, tracking as tracking
from ._observability import (
    Observability as Observability,
    bending as bending,
    detectability_rate as detectability_rate,
    observability as observability,
)
from ._virtual import virtual as virtual
