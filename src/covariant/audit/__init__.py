"""The laws that an intrinsic observer's convergence rests on, measured at random states."""

from covariant.audit._audit import LAWS, Audit, Law, audit

__all__ = ["LAWS", "Audit", "Law", "audit"]
