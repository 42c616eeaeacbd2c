"""From JAX to a graph: reading functions, simplifying, derivatives, fingerprints."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
