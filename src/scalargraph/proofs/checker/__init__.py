"""An independent check, by Taylor models, of what branch and bound has proved in intervals.

To be independent it shares no bound of any operation with the prover, only the reader of jaxprs, which knows the forms
of JAX's releases: it evaluates JAX's programs itself, and relies on IEEE `+ − × ÷ √` alone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
