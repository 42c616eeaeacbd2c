"""Shows systems for which Theorem 2 of Jouffroy & Fossen 2004 is wrong as printed."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from covariant import models
from covariant.certificates import contraction, virtual
from covariant.observers import Contracting
from scalargraph.proofs import Box, Proof, prove


class Scalar(NamedTuple):
    """A scalar system with observer feedback, as a counter-example: `x' = ax + bu`, z = x, `u = gx̂`.

    Attributes:
        a: Coefficient of the state [1/s].
        b: Coefficient of the input.
        g: Gain of the feedback of the estimate.
        k: Gain of the observer [1/s].

    Example:
        >>> from covariant.papers.jouffroy_fossen import Scalar
        >>> case = Scalar(a=1.0, b=1.0, g=-10.0, k=0.0)
        >>> case.printed, case.true
        (-9.0, 1.0)
    """

    a: float
    b: float
    g: float
    k: float

    @property
    def printed(self) -> float:
        """The printed Jacobian `a + bg − k` [1/s]; if it is negative, the system is said to contract."""
        return self.a + self.b * self.g - self.k

    @property
    def true(self) -> float:
        """The true rate of the observer's error, `a − k` [1/s]."""
        return self.a - self.k

    def observer(self) -> Contracting:
        """The observer `x̂' = ax̂ + bu + k(z − x̂)` of the system, which starts at 0."""
        model = models.StateSpace(
            lambda t, x, u: self.a * x + self.b * u,
            lambda t, x, u: x,
            coordinates=("x",),
            inputs=1,
        )
        return Contracting(model, jnp.array([[self.k]]), jnp.zeros(1))

    def proof(self, rate: float) -> Proof:
        """Prove that the virtual system contracts, over |x|, |u|, |z| ≤ 1.

        Args:
            rate: Rate of squared lengths [1/s].

        Returns:
            The proof, or its refutation.
        """
        error_system = virtual(self.observer(), jnp.eye(1))
        size = len(error_system.names)
        return prove(
            contraction(error_system, rate), Box(error_system.names, error_system.units, -np.ones(size), np.ones(size))
        )


# The printed and the true rate have opposite signs in each pair: −9 and 1, −2.5 and 0.5, 4 and −1 [1/s].
COUNTEREXAMPLES = {
    "called contracting, diverges": Scalar(1.0, 1.0, -10.0, 0.0),
    "called contracting, diverges slowly": Scalar(1.0, 1.0, -3.0, 0.5),
    "called not contracting, converges": Scalar(-1.0, 1.0, 5.0, 0.0),
}
"""Systems for which (16) and (20) as printed state the opposite of the truth."""
