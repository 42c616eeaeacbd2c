"""The chain of pendulums against mass points moved by hand: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_pendulum_chain import TRIPLE

from covariant.models import acceleration, energy, pendulum_chain

TIME = jnp.zeros(())


SAMPLES = 8


def states(n, inputs, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-3, 3, (SAMPLES, n)), rng.normal(size=(SAMPLES, n)), rng.normal(size=(SAMPLES, inputs))


def by_hand(absolute, zero=-1.0, p=TRIPLE):
    """Kinetic, potential energy and generalised forces of the triple pendulum, link by link, y upwards.

    `absolute` gives the absolute angles from the chart's; `zero` is −1 where they count from hanging.
    """

    def bodies(q):
        """Positions of the centres of mass, and the angles of links and rotors."""
        link, joint, centres = absolute(q), jnp.zeros(2), []
        for i in range(3):
            way = jnp.stack([jnp.sin(link[i]), zero * jnp.cos(link[i])])
            centres.append(joint + p["com"][i] * way)
            joint = joint + p["length"][i] * way
        turns = joints(q)
        rotor = [(link[i - 1] if i else 0.0) - p["gear"][i] * turns[i] for i in range(3)]
        return jnp.stack(centres), link, jnp.stack(rotor)

    def joints(q):
        link = absolute(q)
        return jnp.stack([link[0], link[1] - link[0], link[2] - link[1]])

    def kinetic(q, v):
        speed, rate, rotor = jax.jvp(bodies, (q,), (v,))[1]
        masses, inertia, rotors = (jnp.array(p[key]) for key in ("mass", "inertia", "rotor_inertia"))
        return (masses @ jnp.sum(speed**2, axis=1) + inertia @ rate**2 + rotors @ rotor**2) / 2

    def potential(q):
        return p["gravity"] * (jnp.array(p["mass"]) @ bodies(q)[0][:, 1])

    def forces(q, v, u):
        """By virtual work of the joint torques."""
        rate = jax.jvp(joints, (q,), (v,))[1]
        torque = jnp.array(p["offset"]) + jnp.stack([u[1], 0.0 * u[0], u[0]])
        torque -= jnp.array(p["viscous"]) * rate + jnp.array(p["coulomb"]) * jnp.arctan(100 * rate)
        return jax.vjp(joints, q)[1](torque)[0]

    return kinetic, potential, forces


def euler_lagrange(kinetic, potential, forces):
    def forward(q, v, u):
        def lagrangian(q, v):
            return kinetic(q, v) - potential(q)

        inertia = jax.hessian(lagrangian, 1)(q, v)
        momentum_rate = jax.jvp(lambda q: jax.grad(lagrangian, 1)(q, v), (q,), (v,))[1]
        return jnp.linalg.solve(inertia, jax.grad(lagrangian)(q, v) + forces(q, v, u) - momentum_rate)

    return forward


CHARTS = {"relative": jnp.cumsum, "absolute": lambda q: q}


@pytest.mark.exhaustive
@pytest.mark.parametrize(("zero", "sign"), [("hanging", -1.0), ("upright", 1.0)])
@pytest.mark.parametrize("angles", CHARTS)
def test_triple_pendulum_is_the_one_moved_by_hand(angles, zero, sign):
    """Euler–Lagrange equations of positions in the plane, in both charts, with rotors, friction and two motors."""
    model = pendulum_chain(**TRIPLE, angles=angles, zero=zero)
    kinetic, potential, forces = by_hand(CHARTS[angles], sign)
    by_euler_lagrange = euler_lagrange(kinetic, potential, forces)

    @jax.jit
    @jax.vmap
    def both(q, v, u):
        energies = energy(model, q, v), kinetic(q, v) + potential(q)
        return acceleration(model, TIME, q, v, u), by_euler_lagrange(q, v, u), *energies

    mine, theirs, my_energy, their_energy = both(*states(3, 2))
    np.testing.assert_allclose(mine, theirs, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(my_energy, their_energy, rtol=1e-13)
