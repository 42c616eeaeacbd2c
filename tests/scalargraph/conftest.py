"""Strict numerics; these tests run without covariant too."""

import hypothesis
import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

hypothesis.settings.register_profile("laws", derandomize=True, deadline=None, database=None, max_examples=60)
hypothesis.settings.load_profile("laws")
