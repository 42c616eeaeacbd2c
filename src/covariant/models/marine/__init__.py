"""Models of ships and underwater vehicles, with parameters that name their sources."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
