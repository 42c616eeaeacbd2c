"""The chain of pendulums against mass points moved by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant.models import pendulum_chain

TRIPLE = {"mass": (1.0, 0.5, 0.7), "length": (1.0, 0.8, 0.6), "com": (0.6, 0.4, 0.7), "inertia": (0.1, 0.05, 0.02)}
TRIPLE |= {"rotor_inertia": (0.01, 0.02, 0.03), "gear": (3.0, -2.0, 5.0), "gravity": 9.0}
TRIPLE |= {"viscous": (0.1, 0.2, 0.3), "coulomb": (0.2, 0.1, 0.05), "offset": (0.3, -0.2, 0.1), "actuated": (2, 0)}


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
