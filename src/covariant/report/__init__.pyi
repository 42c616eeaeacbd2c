from ._article import block_html as block_html, write_article as write_article
from ._certificate import certificate_figure as certificate_figure
from ._estimate import Along as Along, EstimateReport as EstimateReport
from ._html import write_report as write_report
from ._png import figure as figure
from ._style import PALETTE as PALETTE, new_figure as new_figure, save_figure as save_figure
from ._table import table as table

__all__ = ["PALETTE", "new_figure", "save_figure", "table"]
