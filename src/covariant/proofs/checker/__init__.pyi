from ._definite import show_definite as show_definite
from ._enclosure import TaylorEnclosure as TaylorEnclosure
from ._plain import plain as plain
from ._series import series as series
from ._taylor import ROUND as ROUND
from ._tree import halves as halves, leaves as leaves
