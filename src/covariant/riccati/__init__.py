"""Contraction metrics of general nonlinear systems, from a Riccati equation solved along characteristics.

For `x' = f(x)`, `y = h(x)` a metric P with

    L_f P = dhᵀ R⁻¹ dh − λ P − P Q P,      L_f P = Ṗ + P f_x + f_xᵀ P,

makes f contract in every direction that is tangent to the level sets of the output, so that output injection can make
it contract in all. P(x) measures how well the past output determines the state x: with λ alone it is the weighted
Gramian of the past, with Q alone the information matrix of a stationary Kalman filter.

Source: Sanfelice & Praly 2015, Solution of a Riccati equation for the design of an observer contracting a Riemannian
distance.
"""

from covariant.riccati._characteristic import Characteristic, metric_through
from covariant.riccati._equation import Equation, lie_derivative, right_side
from covariant.riccati._high_gain import high_gain
from covariant.riccati._solution import (
    RiccatiMetric,
    Solution,
    gramian,
    gramians,
    metric_at,
    rate_from_gramian,
    reconstructibility,
    spd_distance,
)
from covariant.riccati._window import Window, window_at

__all__ = [
    "Characteristic",
    "Equation",
    "RiccatiMetric",
    "Solution",
    "Window",
    "gramian",
    "gramians",
    "high_gain",
    "lie_derivative",
    "metric_at",
    "metric_through",
    "rate_from_gramian",
    "reconstructibility",
    "right_side",
    "spd_distance",
    "window_at",
]
