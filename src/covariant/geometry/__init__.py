"""Riemannian geometry of any metric, and spaces with closed forms. Knows no machine and no time."""

from covariant.geometry._abstract import AbstractMetric, Budget, Shot, Transported, inner, norm
from covariant.geometry._functions import (
    as_metric,
    christoffel,
    curvature,
    distance,
    exp,
    gradient,
    log,
    shoot,
    transport,
    transport_along,
)
from covariant.geometry._interpolated import Interpolated
from covariant.geometry._numeric import Metric
from covariant.geometry._spaces import ConstantCurvature, Euclidean, FlatTorus, Product, Pullback, hyperbolic, sphere

__all__ = [
    "AbstractMetric",
    "Budget",
    "ConstantCurvature",
    "Euclidean",
    "FlatTorus",
    "Interpolated",
    "Metric",
    "Product",
    "Pullback",
    "Shot",
    "Transported",
    "as_metric",
    "christoffel",
    "curvature",
    "distance",
    "exp",
    "gradient",
    "hyperbolic",
    "inner",
    "log",
    "norm",
    "shoot",
    "sphere",
    "transport",
    "transport_along",
]
