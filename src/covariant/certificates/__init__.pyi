from . import audit as audit
from ._assumed import ASSUMED as ASSUMED
from ._cascade import (
    CascadeCertificate as CascadeCertificate,
    Constants as Constants,
    Growth as Growth,
    cascade as cascade,
)
from ._certify import CHECKERS as CHECKERS, CheckerName as CheckerName, certify as certify
from ._checked import Checked as Checked, check as check
from ._claims import Claim as Claim
from ._contraction import (
    StateMetric as StateMetric,
    contraction_matrix as contraction_matrix,
    contraction_rate as contraction_rate,
    generalised_jacobian as generalised_jacobian,
    in_coordinates as in_coordinates,
    in_frame as in_frame,
    log_norm as log_norm,
    rates_along as rates_along,
)
from ._contraction_certificate import ContractionCertificate as ContractionCertificate
from ._corners import Corners as Corners, at_corners as at_corners
from ._distance import (
    Decay as Decay,
    decay as decay,
    lower_distance as lower_distance,
    upper_distance as upper_distance,
)
from ._distance_certificate import DistanceCertificate as DistanceCertificate, certify_distance as certify_distance
from ._document import Document as Document, parse as parse
from ._error_system import ErrorSystem as ErrorSystem
from ._falsify import falsify as falsify
from ._figures import Projection as Projection, TradeOff as TradeOff, projection as projection, trade_off as trade_off
from ._force_bounds import force_bounds as force_bounds
from ._inequalities import contraction as contraction, correction as correction
from ._intrinsic import error_system as error_system
from ._largest import Attempt as Attempt, Largest as Largest, largest as largest
from ._lmi import MetricDesign as MetricDesign, common_metric as common_metric, observer_gain as observer_gain
from ._marine_cascade import crossed_metric as crossed_metric, feedthrough as feedthrough, tracking as tracking
from ._noise import (
    error_bounds as error_bounds,
    noise_disturbance as noise_disturbance,
    steady_distance as steady_distance,
)
from ._observability import (
    Observability as Observability,
    bending as bending,
    detectability_rate as detectability_rate,
    observability as observability,
)
from ._reduced_order import ReducedOrderDesign as ReducedOrderDesign, reduced_order as reduced_order
from ._sample import Sampled as Sampled, check_sample as check_sample
from ._sampled_bound import (
    BoundInfo as BoundInfo,
    BoundState as BoundState,
    Premise as Premise,
    SampledBound as SampledBound,
)
from ._sampled_step import sampled_system as sampled_system
from ._sampling import Sampling as Sampling
from ._simulated import (
    Followed as Followed,
    Trajectories as Trajectories,
    follow_estimates as follow_estimates,
    trajectories as trajectories,
)
from ._start import Start as Start
from ._statement import (
    Evidence as Evidence,
    Hypothesis as Hypothesis,
    Statement as Statement,
    Verdict as Verdict,
)
from ._tangent_metric import (
    conditioning as conditioning,
    error_matrix as error_matrix,
    lyapunov as lyapunov,
    optimal_lyapunov as optimal_lyapunov,
    rate_of as rate_of,
    tangent_metric as tangent_metric,
)
from ._virtual import virtual as virtual

__all__ = [
    "Hypothesis",
    "SampledBound",
    "Statement",
    "audit",
    "cascade",
    "certify",
    "check",
    "contraction",
    "lyapunov",
    "observability",
    "virtual",
]
