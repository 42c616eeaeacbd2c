"""Figures and pages from arrays: estimates, certificates and audits drawn for people. No mathematics of observers here.

matplotlib and plotly are optional packages, loaded by the functions that draw and installed by
`pip install 'covariant[report]'`.
"""

from covariant.report._article import write_article
from covariant.report._audit import draw_audit, write_audit
from covariant.report._certificate import draw_certificate
from covariant.report._estimate import EstimateReport
from covariant.report._html import write_html
from covariant.report._png import write_png
from covariant.report._style import PALETTE, new_figure, save_figure
from covariant.report._table import table

__all__ = [
    "PALETTE",
    "EstimateReport",
    "draw_audit",
    "draw_certificate",
    "new_figure",
    "save_figure",
    "table",
    "write_article",
    "write_audit",
    "write_html",
    "write_png",
]
