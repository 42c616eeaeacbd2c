"""What takes long of `test_cache_folder.py`."""

from test_cache_folder import cache, python

JITTED = """
import covariant, jax, jax.numpy as jnp
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
print(float(jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))(jnp.ones(5))))
"""


def test_jax_compiles_a_program_again_that_was_changed(cache):
    """It would warn of a truncated one at every start, and may crash by a patched one."""
    first = python(JITTED)
    assert python("import covariant").returncode == 0
    entries = sorted(cache.glob("*-cache"))
    for k, entry in enumerate(entries):
        content, half = entry.read_bytes(), entry.stat().st_size // 2
        flipped = content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :]
        entry.write_bytes((content[:half], flipped, bytes(len(content)))[k % 3])
    again = python(JITTED)
    assert (again.returncode, again.stdout, again.stderr) == (0, first.stdout, "")
    assert sorted(cache.glob("*-cache")) == entries
