"""Model files with open numbers, and model files written anew with other values."""

import tomllib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models

TEXT = """# a rough model
system = "pendulum_chain"

[parameters]   # from CAD
source = "CAD"
mass = [0.6,   # kg, first link
        0.4]   # second
length = [0.3, 0.25]
gravity = 9.81          # m/s^2
[inputs]
lag = 0.01

[measurement]
quantum = 1e-3
"""


@pytest.fixture
def spec(tmp_path):
    (tmp_path / "model.toml").write_text(TEXT)
    return str(tmp_path / "model.toml")


def test_a_family_makes_the_models_of_other_files(spec):
    family = models.family(spec, ["mass", "parameters.gravity", "inputs.lag"])
    assert family.names == ("mass[0]", "mass[1]", "gravity", "inputs.lag")
    assert family.positive == (True, True, False, True)
    model, lag = family.make(np.array([1.0, 2.0, 3.0, 0.5]))
    direct = models.load(spec, ["parameters.mass=[1.0, 2.0]", "parameters.gravity=3.0"]).model
    assert eqx.tree_equal(model, direct)
    assert lag == 0.5
    assert family.with_values(np.array([1.0, 2.0, 3.0, 0.5]))["parameters"]["mass"] == [1.0, 2.0]
    assert family.document["parameters"]["mass"] == [0.6, 0.4]


SYSTEMS = {
    "ball_and_beam": {"mass": 0.5},
    "heavy_top": {"inertia": [0.2, 0.2, 0.1], "moment": 1.0},
    "hovercraft": {"mass": 5.0, "drag": [0.3, 0.5, 0.02]},
    "oscillator": {"stiffness": 1.0},
    "pendulum_chain": {"mass": [1.0, 2.0], "inertia": [0.1, 0.2]},
    "ship": {"mass": [1650.0, 2300.0, 4200.0], "rudder": 110.0, "propeller": 2.0},
    "satellite": {"inertia": [0.05, 0.06, 0.04], "wheel_inertia": 2e-4},
    "underwater_vehicle": {"mass": 12.0, "added_mass": [5.0, 12.0, 14.0, 0.1, 0.2, 0.2]},
}


@pytest.mark.core(1)
@pytest.mark.parametrize("system", SYSTEMS)
def test_the_numbers_of_ready_made_systems_may_be_traced(system):
    overrides = [f"parameters.{key}={value}" for key, value in SYSTEMS[system].items()]
    family = models.family(system, list(SYSTEMS[system]), overrides)
    traced = jax.jit(lambda values: eqx.filter(family.make(values)[0], eqx.is_array))(family.first)
    plain = eqx.filter(family.file.model, eqx.is_array)
    for one, other in zip(jax.tree.leaves(traced), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-15)


def closed_over(mass: float = 1.0):
    return models.Lagrangian(lambda q: float(mass) * jnp.eye(1), coordinates=("q",))


@pytest.mark.parametrize(
    ("names", "overrides", "message"),
    [
        (["mas"], (), "unknown number 'mas'. Did you mean"),
        (["mass", "mass[1]"], (), r"mass\[1\] is named twice"),
        (["source"], (), "unknown number 'source'"),
        (["viscous"], ("parameters.viscous=[0.0, 0.1]",), r"viscous\[0\] must be positive and starts from 0; give it"),
    ],
)
def test_wrong_names_and_values_are_told(spec, names, overrides, message):
    with pytest.raises(models.ModelError, match=message):
        models.family(spec, names, overrides)


def test_a_function_that_jax_cannot_trace_is_told():
    with pytest.raises(models.ModelError, match=r"cannot be traced by JAX .*; compute with jax\.numpy in it"):
        models.family(f"{__name__}:closed_over", ["mass"], ["parameters.mass=1.0"])


def test_comments_and_layout_remain_when_values_change():
    content = tomllib.loads(TEXT)
    content["parameters"] |= {"mass": [0.75, 0.4], "gravity": 9.8, "viscous": [0.1, 0.2], "source": 'a "fit"'}
    content["inputs"]["lag"] = 0.02
    content["reference"] = {"half": 0.05}
    text = models.rewrite(TEXT, content)
    assert tomllib.loads(text) == content
    assert "mass = [0.75,   # kg, first link\n        0.4]   # second\n" in text
    assert "gravity = 9.8          # m/s^2\nviscous = [0.1, 0.2]\n[inputs]" in text
    assert text.startswith(
        '# a rough model\nsystem = "pendulum_chain"\n\n[parameters]   # from CAD\nsource = "a \\"fit'
    )
    del content["measurement"]["quantum"]
    content["measurement"]["std"] = 1e-3
    assert tomllib.loads(models.rewrite(TEXT, content)) == content
    assert models.rewrite(TEXT, tomllib.loads(TEXT)) == TEXT


def test_a_table_within_another_stays_under_its_header():
    text = (
        'system = "robot"\n[parameters]\npath = "arm.urdf"\n[parameters.armature]\nelbow = 0.01  # a rotor\n'
        '[parameters.friction.elbow]\nviscous = 0.1\n[inputs]\nbetween = "held"\n'
    )
    content = tomllib.loads(text)
    content["parameters"]["armature"] = {"elbow": 0.02, "wrist": 0.01}
    content["parameters"]["friction"] = {"elbow": {"viscous": 0.2, "coulomb": 0.3}, "wrist": {"viscous": 0.4}}
    content["parameters"]["torque_constants"] = {"elbow": 1.1}
    written = models.rewrite(text, content)
    assert tomllib.loads(written) == content
    assert "[parameters.armature]\nelbow = 0.02  # a rotor\nwrist = 0.01\n[parameters.friction.elbow]" in written


def test_a_layout_that_is_not_followed_is_refused():
    text = 'system = "oscillator"\nparameters.stiffness = 1.0\n'
    with pytest.raises(ValueError, match=r"\[parameters\] is written in a way that cannot be changed"):
        models.rewrite(text, {"system": "oscillator", "parameters": {"stiffness": 2.0}})


def test_a_new_key_takes_the_place_of_the_comment_that_drafts_it():
    text = (
        "[uncertainty]\n# acceleration of the load: see the manual = page 3\n# acceleration = 2.0  # rad/s^2\n"
        "# correlation_time = 0.01  # s\n\n[measurement]\n# std = tick / sqrt(12)\nquantum = 1e-3\n"
    )
    content = {"uncertainty": {"acceleration": 5.5}, "measurement": {"quantum": 1e-3, "std": 2e-4}}
    written = models.rewrite(text, content)
    assert tomllib.loads(written) == content
    assert "acceleration = 5.5  # rad/s^2\n# correlation_time = 0.01" in written
    assert "# std = tick / sqrt(12)\nquantum = 0.001\nstd = 0.0002" in written.replace("1e-3", "0.001")
