"""The chain of pendulums against mass points moved by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import acceleration, energy, pendulum_chain

TIME = jnp.zeros(())
SAMPLES = 8
TRIPLE = {"mass": (1.0, 0.5, 0.7), "length": (1.0, 0.8, 0.6), "com": (0.6, 0.4, 0.7), "inertia": (0.1, 0.05, 0.02)}
TRIPLE |= {"rotor_inertia": (0.01, 0.02, 0.03), "gear": (3.0, -2.0, 5.0), "gravity": 9.0}
TRIPLE |= {"viscous": (0.1, 0.2, 0.3), "coulomb": (0.2, 0.1, 0.05), "offset": (0.3, -0.2, 0.1), "actuated": (2, 0)}


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


def test_an_inertia_about_the_joint_includes_the_mass():
    chain = pendulum_chain((2.0,), (0.7,), (0.4,), (0.37,), inertia_about="joint")
    assert chain.metric(jnp.zeros(1))[0, 0] == pytest.approx(0.37, rel=1e-14)


def test_point_mass_sits_at_the_end_by_default():
    assert pendulum_chain((2.0,), (0.7,)).metric(jnp.zeros(1))[0, 0] == pytest.approx(2.0 * 0.49, rel=1e-14)


def test_chain_describes_itself():
    model = pendulum_chain(**TRIPLE, source="a data sheet")
    assert model.coordinates == ("q1", "q2", "q3")
    assert model.circles == (0, 1, 2)
    assert model.units == ("rad",) * 3
    mass = model.parameters["mass"]
    assert (mass.value.tolist(), mass.unit, mass.source) == ([1.0, 0.5, 0.7], "kg", "a data sheet")
    assert model.parameters["gravity"].value == 9.0


# Wrong parameters

WRONG = {
    "length": {"length": (1.0,)},
    "com": {"com": (1.0, 1.0, 1.0)},
    "inertia": {"inertia": (0.1,)},
    "rotor_inertia": {"rotor_inertia": (0.1, -0.1)},
    "gear": {"gear": (1.0,)},
    "viscous": {"viscous": (-0.1, 0.1)},
    "coulomb": {"coulomb": (0.1, -0.1)},
    "offset": {"offset": (np.nan, 0.0)},
    "mass": {"mass": (1.0, -1.0)},
    "mass must be finite; got \\(inf, 1.0\\)": {"mass": (np.inf, 1.0)},
    "angles": {"angles": "relativ"},
    "zero": {"zero": "down"},
    "inertia_about": {"inertia_about": "centre"},
    "actuated": {"actuated": (0, 2)},
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_parameter_is_named(name):
    with pytest.raises(ValueError, match=f"^pendulum_chain: {name}"):
        pendulum_chain(**WRONG[name])
