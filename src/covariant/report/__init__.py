"""Draws estimates and certificates for people, as figures and pages, from arrays; it computes no estimates itself.

matplotlib and plotly are optional packages, loaded by the functions that draw and installed by
`pip install 'covariant[report]'`.
"""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
