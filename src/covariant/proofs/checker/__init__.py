"""An independent check, by Taylor models, of what branch and bound has proved in intervals.

To be independent it shares nothing with the prover: it reads JAX's programs itself, and relies on IEEE `+ − × ÷ √`
alone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
