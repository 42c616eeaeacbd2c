"""Controllers that use the estimate of an observer, and the references they follow."""

from covariant.control._backstepping import Backstepping
from covariant.control._reference import Reference, follow, lissajous, set_point

__all__ = ["Backstepping", "Reference", "follow", "lissajous", "set_point"]
