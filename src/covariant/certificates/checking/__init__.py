"""The checker: claims of a file, whose matrices are formed anew and bounded in another way."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
