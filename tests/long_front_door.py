"""What the package offers by its name, and what that costs to load: what takes long."""

import pytest
from test_front_door import python

import covariant


@pytest.mark.parametrize("before", ["", "import jax; "])
def test_arrays_are_double_from_the_import_on(before):
    script = f"{before}import covariant; import jax.numpy as jnp; print(jnp.ones(1).dtype)"
    assert python(script) == "float64"


COMPILES = """
import covariant, jax, jax.numpy as jnp
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
print(float(jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))(jnp.ones(5))), jax.config.jax_compilation_cache_dir)
"""


def test_programs_are_kept_and_loaded_without_a_word(tmp_path):
    first = python(COMPILES, COVARIANT_CACHE=str(tmp_path))
    kept = sorted(tmp_path.rglob("*-cache"))
    assert kept
    assert str(tmp_path) in first
    assert python(COMPILES, COVARIANT_CACHE=str(tmp_path)) == first  # nothing on stderr either
    assert sorted(tmp_path.rglob("*-cache")) == kept
