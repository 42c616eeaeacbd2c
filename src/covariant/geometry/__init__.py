"""Configuration spaces: manifolds with a frame, and metrics on them, with closed forms where these are known."""

from covariant.geometry._functions import (
    christoffel,
    connection,
    curvature,
    distance,
    exp,
    gradient,
    inner,
    log,
    norm,
    sectional_curvature,
    shoot,
    transport,
    transport_along,
)
from covariant.geometry._geodesics import Budget, Shot, Transported
from covariant.geometry._interpolated import Interpolated
from covariant.geometry._manifold import AbstractManifold, Coordinates, ProductManifold, wrap
from covariant.geometry._metric import AbstractMetric, KineticEnergy, Metric, as_space
from covariant.geometry._space import AbstractSpace, derivative, differential
from covariant.geometry._spaces import ConstantCurvature, Euclidean, FlatTorus, Product, Pullback, hyperbolic, sphere

__all__ = [
    "AbstractManifold",
    "AbstractMetric",
    "AbstractSpace",
    "Budget",
    "ConstantCurvature",
    "Coordinates",
    "Euclidean",
    "FlatTorus",
    "Interpolated",
    "KineticEnergy",
    "Metric",
    "Product",
    "ProductManifold",
    "Pullback",
    "Shot",
    "Transported",
    "as_space",
    "christoffel",
    "connection",
    "curvature",
    "derivative",
    "differential",
    "distance",
    "exp",
    "gradient",
    "hyperbolic",
    "inner",
    "log",
    "norm",
    "sectional_curvature",
    "shoot",
    "sphere",
    "transport",
    "transport_along",
    "wrap",
]
