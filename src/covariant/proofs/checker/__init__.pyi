from ._definite import show_definite as show_definite, show_tree as show_tree
from ._enclosure import TaylorEnclosure as TaylorEnclosure
from ._plain import plain as plain
from ._series import series as series
from ._taylor import ROUND as ROUND
from ._tree import SavedTree as SavedTree, halves as halves, leaves as leaves
