"""covariant: intrinsic and contracting observers for mechanical systems.

Importing it loads nothing heavy: a subpackage, such as `covariant.models`, is loaded on first use. From then on JAX
works in double precision, and its compiled programs are cached in the user's cache folder (`COVARIANT_CACHE`).
"""

import os
import sys

import lazy_loader

from covariant._programs import keep_programs
from scalargraph.cache import name_cache

# JAX reads this variable when it is imported, which may happen long after this, or may have happened already.
os.environ["JAX_ENABLE_X64"] = "1"
if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)
name_cache("covariant", "COVARIANT_CACHE")
keep_programs()

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
