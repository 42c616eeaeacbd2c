from .base import (
    ASSUMED as ASSUMED,
    AbstractClaim as AbstractClaim,
    Document as Document,
    Hypothesis as Hypothesis,
    Start as Start,
    Statement as Statement,
    any_configuration as any_configuration,
    check_observer as check_observer,
    contraction as contraction,
    contraction_rate as contraction_rate,
    error_system as error_system,
    lyapunov as lyapunov,
    optimal_lyapunov as optimal_lyapunov,
    parse as parse,
    tangent_metric as tangent_metric,
)
from .checking import Checked as Checked, check as check
from .everywhere import certify_globally as certify_globally, check_globally as check_globally
from .proving import (
    Attempt as Attempt,
    CheckerName as CheckerName,
    ContractionCertificate as ContractionCertificate,
    Projection as Projection,
    Trajectories as Trajectories,
    certify as certify,
    largest as largest,
    projection as projection,
    trajectories as trajectories,
)
from .sampled import (
    Bounded as Bounded,
    LostRows as LostRows,
    Premise as Premise,
    check_interval as check_interval,
    sampled_system as sampled_system,
)
from .theory import (
    CascadeCertificate as CascadeCertificate,
    Corners as Corners,
    MetricDesign as MetricDesign,
    at_corners as at_corners,
    cascade as cascade,
    common_metric as common_metric,
    crossed_metric as crossed_metric,
    decay as decay,
    falsify as falsify,
    feedthrough as feedthrough,
    observability as observability,
    observer_gain as observer_gain,
    tracking as tracking,
    virtual as virtual,
)

__all__ = [
    "Bounded",
    "Hypothesis",
    "Statement",
    "cascade",
    "certify",
    "check",
    "contraction",
    "lyapunov",
    "observability",
    "virtual",
]
