"""Masses that move each on its own: equations of motion, as a first guess."""

import jax.numpy as jnp

from covariant.models import Lagrangian, Parametric


def kinetic(q, mass):
    """The inertia matrix (n, n): the kinetic energy is half of v' M(q) v."""
    return jnp.diag(mass)


def potential(q, weight):
    """The potential energy [J]."""
    return weight @ q


def make(mass, weight, viscous, coulomb):
    """The machine with the numbers of [parameters]."""
    energy = Parametric(kinetic, mass=jnp.asarray(mass))
    return machine(energy, Parametric(potential, weight=jnp.asarray(weight)), viscous, coulomb)


#: xMACHINEx
