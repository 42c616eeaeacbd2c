"""Configuration spaces: manifolds with a frame, and metrics on them, with closed forms where these are known."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
