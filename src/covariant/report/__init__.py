"""Figures and pages from arrays: estimates, certificates and audits drawn for people. No mathematics of observers here.

matplotlib and plotly are optional packages, loaded by the functions that draw and installed by
`pip install 'covariant[report]'`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
