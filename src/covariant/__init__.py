"""covariant: intrinsic and contracting observers for mechanical systems."""

import jax as _jax

_jax.config.update("jax_enable_x64", True)
