from ._characteristic import Characteristic as Characteristic, metric_through as metric_through
from ._equation import (
    Equation as Equation,
    lie_derivative as lie_derivative,
    right_side as right_side,
    with_time as with_time,
)
from ._grid import Grid as Grid
from ._high_gain import high_gain as high_gain
from ._map import map_grid as map_grid
from ._metric_on_grid import (
    MetricSummary as MetricSummary,
    load_metric as load_metric,
    metric_on_grid as metric_on_grid,
    metric_summary as metric_summary,
    open_metric as open_metric,
)
from ._solution import (
    RiccatiMetric as RiccatiMetric,
    Solution as Solution,
    gramian as gramian,
    gramians as gramians,
    metric_at as metric_at,
    rate_from_gramian as rate_from_gramian,
    reconstructibility as reconstructibility,
    spd_distance as spd_distance,
)
from ._store import Variable as Variable, open_grid as open_grid
from ._window import Window as Window, window_at as window_at

__all__ = ["Equation", "Grid", "RiccatiMetric", "high_gain", "load_metric", "metric_at"]
