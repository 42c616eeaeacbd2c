"""The sampled step contracts as its matrices say, in coordinates and on rotations, and errs as little as claimed."""

import jax.numpy as jnp
import numpy as np
import pytest

from scalargraph.proofs.checker import series


def test_series_of_a_choice_that_the_number_does_not_make():
    chosen = np.array([[True, False], [False, True]])

    def function(r):
        return jnp.where(chosen, jnp.sin(r), r * r)

    coefficients = series(function, 3)(jnp.array(0.3))
    for k, expected in enumerate(([np.sin(0.3), 0.09], [np.cos(0.3), 0.6], [-np.sin(0.3) / 2, 1.0])):
        assert np.allclose(coefficients[k], np.where(chosen, *expected))
    for jumps in (lambda r: jnp.where(r > 0, r, r * r), jnp.abs):
        with pytest.raises(ValueError, match=r"'?(gt|lt|abs)'? has no known expansion"):
            series(jumps, 2)(jnp.array(0.5))
