"""Types and shapes of arguments are checked while the exhaustive suite runs."""

import jax.numpy as jnp
import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation

from covariant import models
from covariant._linalg import solve
from scalargraph.proofs._file import Field
from scalargraph.proofs.checker import show_definite

pytestmark = pytest.mark.exhaustive


def test_arguments_whose_shapes_disagree_raise_a_type_error():
    with pytest.raises(TypeError, match="b"):
        solve(jnp.eye(3), jnp.ones(2))


def test_a_field_of_a_wrong_type_raises_a_type_error():
    with pytest.raises(TypeError, match="unit"):
        models.Parameter(1.0, unit=2.0, source="measured")


@pytest.mark.parametrize(
    "wrong", [lambda: show_definite("matrix", np.zeros((0, 1)), np.zeros((0, 1)), 1, "it"), lambda: Field(1, "", "")]
)
def test_a_wrong_type_in_the_checker_is_no_refusal(wrong):
    """A file is refused by a `ValueError` or its like, `TypeError` included: this error is none of them."""
    with pytest.raises(BeartypeCallHintViolation) as caught:
        wrong()
    assert not isinstance(caught.value, ValueError | TypeError | LookupError | ArithmeticError | AttributeError)
