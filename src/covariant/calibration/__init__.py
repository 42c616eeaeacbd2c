"""What is wrong with a log, what a model's numbers are, and which noise and gains fit both."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
