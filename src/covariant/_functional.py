"""Base class of models, spaces and observers: functions that hold parameters."""

import equinox as eqx


class Functional(eqx.Module):
    """A module that is compared by identity, as functions are: it equals only itself.

    `jax.jit(model.metric)` caches compiled programs by the function it was called with, in tables that hash and
    compare. The `==` of an `equinox.Module` compares the numbers in it, which are not known where the module is
    constructed inside a compiled function. To compare the numbers of two modules use `equinox.tree_equal`.

    Example:
        >>> import equinox as eqx
        >>> from covariant import models
        >>> one, two = models.oscillator(), models.oscillator()
        >>> one == two, bool(eqx.tree_equal(one, two))
        (False, True)
    """

    def __hash__(self):
        return id(self)

    def __eq__(self, other):
        return self is other
