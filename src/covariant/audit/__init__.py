"""Numerical audit of an intrinsic observer: the laws its convergence rests on, measured at random states."""

from covariant.audit._audit import LAWS, Audit, Law, audit

__all__ = ["LAWS", "Audit", "Law", "audit"]
