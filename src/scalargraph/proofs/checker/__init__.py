"""Checks independently, by Taylor models, what branch and bound has proved in intervals.

The checker shares no bound of any operation with the prover, only the reader of jaxprs, which knows the forms of JAX's
releases. It evaluates JAX's programs itself, and relies on IEEE `+ − × ÷ √` alone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
