"""Certificates: statements about observers with domain, margin and evidence, which can be saved, read and checked."""

from covariant.certificates._assumed import ASSUMED
from covariant.certificates._cascade import CascadeCertificate, Constants, Growth, cascade
from covariant.certificates._certificate import Certificate
from covariant.certificates._certify import certify
from covariant.certificates._check import Checked, check
from covariant.certificates._contraction import (
    StateMetric,
    contraction_matrix,
    contraction_rate,
    generalised_jacobian,
    in_coordinates,
    in_frame,
    log_norm,
    rates_along,
)
from covariant.certificates._contraction_certificate import Claim, ContractionCertificate
from covariant.certificates._distance import Decay, decay, lower_distance, upper_distance
from covariant.certificates._document import Document, parse
from covariant.certificates._falsify import falsify
from covariant.certificates._figures import Projection, TradeOff, projection, trade_off
from covariant.certificates._force_bounds import force_bounds
from covariant.certificates._inequalities import contraction
from covariant.certificates._intrinsic import subject
from covariant.certificates._lmi import MetricDesign, common_metric, observer_gain
from covariant.certificates._marine_cascade import crossed_metric, feedthrough, tracking
from covariant.certificates._noise import error_bounds, noise_disturbance, steady_distance
from covariant.certificates._observability import Observability, bending, detectability_rate, observability
from covariant.certificates._sample import Sampled, check_sample
from covariant.certificates._simulated import Followed, Trajectories, follow_estimates, trajectories
from covariant.certificates._subject import Subject
from covariant.certificates._tangent_metric import (
    conditioning,
    error_matrix,
    lyapunov,
    optimal_lyapunov,
    rate_of,
    tangent_metric,
)
from covariant.certificates._virtual import virtual

__all__ = [
    "ASSUMED",
    "CascadeCertificate",
    "Certificate",
    "Checked",
    "Claim",
    "Constants",
    "ContractionCertificate",
    "Decay",
    "Document",
    "Followed",
    "Growth",
    "MetricDesign",
    "Observability",
    "Projection",
    "Sampled",
    "StateMetric",
    "Subject",
    "TradeOff",
    "Trajectories",
    "bending",
    "cascade",
    "certify",
    "check",
    "check_sample",
    "common_metric",
    "conditioning",
    "contraction",
    "contraction_matrix",
    "contraction_rate",
    "crossed_metric",
    "decay",
    "detectability_rate",
    "error_bounds",
    "error_matrix",
    "falsify",
    "feedthrough",
    "follow_estimates",
    "force_bounds",
    "generalised_jacobian",
    "in_coordinates",
    "in_frame",
    "log_norm",
    "lower_distance",
    "lyapunov",
    "noise_disturbance",
    "observability",
    "observer_gain",
    "optimal_lyapunov",
    "parse",
    "projection",
    "rate_of",
    "rates_along",
    "steady_distance",
    "subject",
    "tangent_metric",
    "tracking",
    "trade_off",
    "trajectories",
    "upper_distance",
    "virtual",
]
