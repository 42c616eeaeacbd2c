"""The oscillator of van der Pol 1926, On relaxation-oscillations: every motion but rest tends to one limit cycle."""

import jax.numpy as jnp

from covariant.models._parameters import Parameter, Parametric, check_parameters, values
from covariant.models._state_space import StateSpace


def van_der_pol(damping: float = 1.0) -> StateSpace:
    """Van der Pol oscillator `q̈ − damping (1 − q²) q̇ + q = 0`, dimensionless, with x = (q, q̇) and y = q.

    Args:
        damping: Damping coefficient, not negative.

    Returns:
        The system with states (q, q_dot) and no input.

    Raises:
        ValueError: The damping is negative or not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> models.van_der_pol(damping=2.0).f(0.0, jnp.array([0.0, 1.0]), jnp.zeros(0)).tolist()
        [1.0, 2.0]
    """
    parameters = {"damping": Parameter(damping, "1", "van der Pol 1926")}
    check_parameters("van_der_pol", parameters, may_vanish=("damping",))
    return StateSpace(
        Parametric(_f, **values(parameters)),
        _h,
        coordinates=("q", "q_dot"),
        units=("1", "1"),
        outputs=("q",),
        # With damping 1 the limit cycle stays within |q| ≤ 2.01 and |q'| ≤ 2.68, inside the box.
        box=((-3.0, 3.0), (-4.0, 4.0)),
        parameters=parameters,
    )


def _f(t, x, u, damping):
    q, v = x
    return jnp.stack([v, damping * (1 - q**2) * v - q])


def _h(t, x, u):
    return x[:1]
