"""Plants, observers and closed loops for other packages."""

from covariant.interop._python_control import closed_loop, observer_system, plant

__all__ = ["closed_loop", "observer_system", "plant"]
