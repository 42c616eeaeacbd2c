from ._enclose import Enclosure as Enclosure, enclose as enclose, fulfilled as fulfilled
from ._intervals import INTERVALS as INTERVALS
from ._rounding import perturbed as perturbed
from ._types import Interval as Interval, Truth as Truth
