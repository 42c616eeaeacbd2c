from . import lie as lie
from ._functions import (
    christoffel as christoffel,
    connection as connection,
    curvature as curvature,
    distance as distance,
    exp as exp,
    log as log,
    sectional_curvature as sectional_curvature,
    shoot as shoot,
    transport as transport,
    transport_along as transport_along,
)
from ._geodesics import Budget as Budget
from ._interpolated import Interpolated as Interpolated
from ._leaf import Leaf as Leaf
from ._manifold import (
    AbstractManifold as AbstractManifold,
    Coordinates as Coordinates,
    ProductManifold as ProductManifold,
    wrap as wrap,
)
from ._metric import (
    AbstractMetric as AbstractMetric,
    KineticEnergy as KineticEnergy,
    Metric as Metric,
    as_space as as_space,
)
from ._space import AbstractSpace as AbstractSpace, derivative as derivative, differential as differential
from ._spaces import (
    Euclidean as Euclidean,
    FlatTorus as FlatTorus,
    Product as Product,
    hyperbolic as hyperbolic,
    sphere as sphere,
)

__all__ = [
    "AbstractSpace",
    "Budget",
    "Coordinates",
    "KineticEnergy",
    "Leaf",
    "Metric",
    "Product",
    "ProductManifold",
    "christoffel",
    "curvature",
    "distance",
    "exp",
    "hyperbolic",
    "lie",
    "log",
    "sectional_curvature",
    "shoot",
    "sphere",
    "transport",
]
