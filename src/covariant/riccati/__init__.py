"""Contraction metrics of general nonlinear systems, from a Riccati equation solved along characteristics.

For `x' = f(x)`, `y = h(x)` a metric P with

    L_f P = dhᵀ R⁻¹ dh − λ P − P Q P,      L_f P = Ṗ + P f_x + f_xᵀ P,

makes f contract in every direction that is tangent to the level sets of the output, so that output injection can make
it contract in all. P(x) measures how well the past output determines the state x: with λ alone it is the weighted
Gramian of the past, with Q alone the information matrix of a stationary Kalman filter.

Source: Sanfelice & Praly 2015, Solution of a Riccati equation for the design of an observer contracting a Riemannian
distance.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
