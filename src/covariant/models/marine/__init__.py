"""Ships and underwater vehicles, with parameters that name their sources."""

from covariant._rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
