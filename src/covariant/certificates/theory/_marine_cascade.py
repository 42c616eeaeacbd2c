"""Builds the arguments of `cascade` for a marine craft with `simulation.Backstepping` and `observers.craft_observer`.

Source: Jouffroy & Fossen 2004, equations (97)–(102).
"""

from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant._domains import FINITE, check_numbers
from covariant._linalg import solve, solve_square
from covariant._typing import Numbers
from covariant.certificates.base import ErrorSystem, Point, in_coordinates
from covariant.certificates.theory._cascade import Coupling
from covariant.certificates.theory._virtual import OutputMetric
from covariant.models.marine import Craft
from covariant.simulation import Backstepping
from scalargraph import jacobian
from scalargraph.errors import InputError


def tracking(controller: Backstepping) -> ErrorSystem:
    """Describe the closed loop with a known state, `e = (η̃, s)`, in the metric diag(K_p, M) of V_con, (91) and (97).

    The variables are the position η (n,), the desired velocity ν_r (n,) and the error s (n,), named `eta_x`, `r_x` and
    `s_x`, with x the name of a coordinate or velocity.

    Args:
        controller: the controller, with its craft and gains.

    Returns:
        The first argument of `cascade`, without its box.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import tracking
        >>> from covariant.models.marine import Craft
        >>> from covariant.simulation import Backstepping, lissajous
        >>> names = {"coordinates": ("x",), "units": ("m",), "velocities": ("u",)}
        >>> craft = Craft(np.eye(1), lambda eta: jnp.eye(1), lambda nu: jnp.eye(1), **names)
        >>> tracking(Backstepping(craft, lissajous([0.0], [0.0], [1.0]), kp=1.0, kd=1.0, lam=1.0)).names
        ('eta_x', 'r_u', 's_u')
    """
    craft = controller.craft
    n = _square(craft)

    def at(z):
        eta, desired, s = jnp.split(z, 3)
        mass, kp, kd, lam = _matrices(controller, z)
        j = craft.transform(eta)

        def flow(t, e):
            nu = desired + e[n:]
            # The plant minus the controller, which has C(ν)ν_r + D(ν_r)ν_r as in (94): C(ν)ν − C(ν)ν_r = C(ν)s.
            force = craft.coriolis(nu) @ e[n:] + craft.damping(nu) @ nu - craft.damping(desired) @ desired
            return jnp.concatenate([j @ e[n:] - lam @ e[:n], -solve(mass, force + kd @ e[n:] + j.T @ (kp @ e[:n]))])

        zero = jnp.zeros((n, n), z.dtype)
        metric = jnp.block([[kp, zero], [zero, mass]])
        return Point(flow, in_coordinates(lambda t, x: metric), jnp.concatenate([jnp.zeros_like(s), s]))

    return ErrorSystem(
        (
            *(f"eta_{name}" for name in craft.coordinates),
            *(f"r_{name}" for name in craft.velocities),
            *(f"s_{name}" for name in craft.velocities),
        ),
        (*craft.units, *craft.velocity_units, *craft.velocity_units),
        at,
    )


def feedthrough(controller: Backstepping) -> Coupling:
    """Build the Jacobians of `b(x̃)` of (98), as functions of the position η and of the desired rate `η_d' − Λη̃`.

    If that rate is zero, this is the paper's b, which assumes a constant J; otherwise the change of J is included.

    Args:
        controller: the controller, with its craft and gains.

    Returns:
        A function of both, as one vector (2n,), to the Jacobians (2n, 2n) by x̃ and by e: the third argument of
        `cascade`, without its box.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import feedthrough
        >>> from covariant.models.marine import Craft
        >>> from covariant.simulation import Backstepping, lissajous
        >>> names = {"coordinates": ("x",), "units": ("m",), "velocities": ("u",)}
        >>> craft = Craft(np.eye(1), lambda eta: jnp.eye(1), lambda nu: jnp.eye(1), **names)
        >>> jacobians = feedthrough(Backstepping(craft, lissajous([0.0], [0.0], [1.0]), kp=1.0, kd=1.0, lam=1.0))
        >>> jacobians(jnp.zeros(2))[0].tolist()
        [[0.0, 0.0], [1.0, 2.0]]
    """
    craft = controller.craft
    n = _square(craft)

    def jacobians(z: Array) -> tuple[Array, Array]:
        eta, desired_rate = jnp.split(z, 2)
        mass, kp, kd, lam = _matrices(controller, z)
        j = craft.transform(eta)
        # ν_r = J⁻¹(asked); its derivative is along the motion of η, whose velocity is that of the estimate.
        transform_change = jacobian(lambda y: solve_square(craft.transform(y), desired_rate), eta)
        nu_r = solve_square(j, desired_rate)
        gyric = jacobian(lambda nu: craft.coriolis(nu) @ nu_r, jnp.zeros_like(eta))
        through_velocity = solve(mass, kd - gyric) + solve_square(j, lam @ j) - transform_change @ j
        zero = jnp.zeros((n, n), z.dtype)
        of_error = jnp.block([[zero, zero], [solve(mass, j.T @ kp), through_velocity]])
        return of_error, jnp.zeros_like(of_error)

    return jacobians


def _matrices(controller: Backstepping, z: Array) -> tuple[Array, ...]:
    """Mass matrix and gains, in the precision of z."""
    whole = controller.craft.mass, controller.kp, controller.kd, controller.lam
    return tuple(jnp.asarray(each, z.dtype) for each in whole)


def _square(craft: Craft) -> int:
    """Number of coordinates, if it is that of the velocities; with a quaternion J would depend on the reference too."""
    if len(craft.coordinates) != len(craft.velocities):
        raise InputError("Theorem 3 needs a craft with as many coordinates as velocities, such as in Euler angles")
    return len(craft.coordinates)


@check_numbers
def crossed_metric(craft: Craft, k2: Annotated[Numbers, FINITE], cross: Annotated[Numbers, FINITE]) -> OutputMetric:
    """Build the metric `[[K2, −JN], [−(JN)ᵀ, M]]` on (η, ν), with a cross term N.

    With N = 0 it is the metric of the observer's Lyapunov function, in which quadratic drag proves no rate at rest.

    Args:
        craft: the craft, with its mass M and transformation J.
        k2: K2 (n, n), symmetric positive definite.
        cross: N (m, m) [kg m/s, with angles too].

    Returns:
        The metric `(z, x) -> (n + m, n + m)`, an argument of `virtual`, where z is the measured position.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import crossed_metric
        >>> from covariant.models.marine import Craft
        >>> names = {"coordinates": ("x",), "units": ("m",), "velocities": ("u",)}
        >>> craft = Craft(np.eye(1), lambda eta: jnp.eye(1), lambda nu: jnp.eye(1), **names)
        >>> crossed_metric(craft, [[2.0]], [[0.5]])(jnp.zeros(1), jnp.zeros(2)).tolist()
        [[2.0, -0.5], [-0.5, 1.0]]
    """

    def metric(z: Array, x: Array) -> Array:
        mass, k, n = (jnp.asarray(np.asarray(a), z.dtype) for a in (craft.mass, k2, cross))
        mixed = -craft.transform(z) @ n
        return jnp.block([[k, mixed], [mixed.T, mass]])

    return metric
