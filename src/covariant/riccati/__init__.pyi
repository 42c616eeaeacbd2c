from ._characteristic import Characteristic as Characteristic, metric_through as metric_through
from ._equation import Equation as Equation, lie_derivative as lie_derivative, right_side as right_side
from ._high_gain import high_gain as high_gain
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
from ._window import Window as Window, window_at as window_at
