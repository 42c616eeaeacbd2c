"""Figures and pages from arrays: estimates and certificates drawn for people. No mathematics of observers here.

matplotlib and plotly are optional packages, loaded by the functions that draw and installed by
`pip install 'covariant[report]'`.
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
