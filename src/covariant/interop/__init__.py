"""Models, observers and closed loops as objects of other packages."""

from covariant.interop._python_control import closed_loop, observer_system, plant

__all__ = ["closed_loop", "observer_system", "plant"]
