from ._enclose import Enclosure as Enclosure, fulfilled as fulfilled
from ._engine import enclose as enclose, in_c as in_c
from ._intervals import INTERVALS as INTERVALS
from ._rounding import perturbed as perturbed
from ._tape import Interval as Interval, Truth as Truth
