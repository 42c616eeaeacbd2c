from ._backstepping import Backstepping as Backstepping
from ._reference import Reference as Reference, follow as follow, lissajous as lissajous, set_point as set_point
