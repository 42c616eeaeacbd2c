"""Statements about convergence, each with its domain, its margin and its evidence."""

from covariant.certificates._certificate import Certificate
from covariant.certificates._observability import Observability, bending, contraction_rate, observability

__all__ = ["Certificate", "Observability", "bending", "contraction_rate", "observability"]
