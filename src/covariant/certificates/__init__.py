"""Statements about convergence, each with its domain, its margin and its evidence."""

from covariant.certificates._assumed import ASSUMED
from covariant.certificates._audit import Audit, Law, audit
from covariant.certificates._cascade import CascadeCertificate, Constants, Growth, cascade
from covariant.certificates._certificate import Certificate
from covariant.certificates._certify import Claim, ContractionCertificate, certify
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
from covariant.certificates._craft import crossed_metric, feedthrough, tracking
from covariant.certificates._distance import Decay, decay, lower_distance, upper_distance
from covariant.certificates._falsify import falsify
from covariant.certificates._form import Form
from covariant.certificates._lmi import MetricDesign, common_metric, observer_gain
from covariant.certificates._noise import error_bounds, noise_disturbance, steady_distance
from covariant.certificates._observability import Observability, bending, detectability_rate, observability
from covariant.certificates._prove import Box, Proof, blocks, box, prove, prove_at_corners
from covariant.certificates._region import Subject, contraction, force_bounds, subject
from covariant.certificates._tangent import (
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
    "Audit",
    "Box",
    "CascadeCertificate",
    "Certificate",
    "Claim",
    "Constants",
    "ContractionCertificate",
    "Decay",
    "Form",
    "Growth",
    "Law",
    "MetricDesign",
    "Observability",
    "Proof",
    "StateMetric",
    "Subject",
    "audit",
    "bending",
    "blocks",
    "box",
    "cascade",
    "certify",
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
    "prove",
    "prove_at_corners",
    "rate_of",
    "rates_along",
    "steady_distance",
    "subject",
    "tangent_metric",
    "tracking",
    "upper_distance",
    "virtual",
]
