from ._audit import LAWS as LAWS, Audit as Audit, Law as Law, audit as audit

__all__ = ["audit"]
