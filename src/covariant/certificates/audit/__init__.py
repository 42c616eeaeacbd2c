"""Numerical audit of an intrinsic observer: the laws its convergence rests on, measured at random states."""

from covariant._rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
