from ._definite import show_definite as show_definite, show_tree as show_tree
from ._enclosure import TaylorEnclosure as TaylorEnclosure
from ._plain import along as along, jacobian as jacobian, plain as plain, value_and_jacobian as value_and_jacobian
from ._series import series as series
from ._taylor import ROUND as ROUND
from ._tree import SavedTree as SavedTree, halves as halves, leaves as leaves
