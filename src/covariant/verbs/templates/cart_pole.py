"""A pole on a cart: equations of motion, as a first guess.

The cart moves along a level rail. The pole turns about a pivot on the cart; its angle is 0 where it hangs, and grows
as its end moves the way that the cart counts as positive. The centre of mass of the pole is `com` below the pivot.
"""

import jax.numpy as jnp

from covariant.models import Lagrangian, Parametric


def kinetic(q, cart_mass, pole_mass, com, inertia):
    """The inertia matrix (2, 2): the kinetic energy is half of v' M(q) v."""
    both = pole_mass * com * jnp.cos(q[1])
    return jnp.stack([jnp.stack([cart_mass + pole_mass, both]), jnp.stack([both, inertia + pole_mass * com**2])])


def potential(q, moment, gravity):
    """The potential energy [J]."""
    return -moment * gravity * jnp.cos(q[1])


def make(cart_mass=1.0, pole_mass=0.1, com=0.15, inertia=0.001, viscous=(0.01, 0.01), coulomb=(0.0, 0.0), gravity=9.81):
    """The machine with the numbers of [parameters]."""
    energy = Parametric(kinetic, cart_mass=cart_mass, pole_mass=pole_mass, com=com, inertia=inertia)
    return machine(energy, Parametric(potential, moment=pole_mass * com, gravity=gravity), viscous, coulomb)


#: xMACHINEx
