"""What is printed was proved: a recipe builds the model, properties are shown, and no evidence is no verdict."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import Hypothesis, certify, certify_globally, falsify
from covariant.certificates.base import Sampling, _properties, error_system, need_known, need_symmetry
from covariant.certificates.sampled import sampled_system
from covariant.certificates.theory import Decay
from covariant.geometry import AbstractSpace, Coordinates, KineticEnergy, Metric, lie
from covariant.geometry.lie import SO3, LeftInvariant
from covariant.models import GroupSystem, Lagrangian, MechanicalSystem
from covariant.observers import Intrinsic
from scalargraph.proofs import box

PENDULUM = {"system": "pendulum_chain", "parameters": {"mass": [1.0], "length": [0.5]}}
GIVEN = {"velocity": 0.5, "error": 0.05, "position": (-0.5, 0.5), "rate": 1.0, "checker": "off", "boxes": 20_000}


def pendulum() -> Lagrangian:
    return models.pendulum_chain((1.0,), (0.5,))


def changed(recipe, **parameters):
    return recipe | {"parameters": recipe["parameters"] | parameters}


# The recipe: names, parameters and functions


@pytest.mark.parametrize(
    ("recipe", "said"),
    [
        (changed(PENDULUM, mass=[7.0]), r"mass is \[7.0\] in the recipe, and \[1.0\] in the model"),
        (changed(PENDULUM, gravity=9.0), "gravity is 9.0 in the recipe, and 9.81"),
        (changed(PENDULUM, mass=[1.0, 1.0], length=[0.5, 0.5]), r"in the recipe, and \[.*\] in the model"),
        ({"system": "oscillator"}, r"coordinates are \('q',\) in the recipe, and \('q1',\)"),
        ({"system": "heavy_top"}, "builds a GroupSystem on LeftInvariant, and the observer has a Lagrangian on Metric"),
        ({"system": "lorenz"}, "builds a StateSpace"),
        ({"system": "nobody"}, "unknown system"),
        ({"attribute": "os:system", "parameters": {"command": "exit 1"}}, "code that a recipe names is not run"),
    ],
)
def test_the_recipe_of_another_model_is_refused_before_a_proof(recipe, said):
    def progress(*_):
        raise AssertionError("a proof has begun")

    with pytest.raises(ValueError, match=said):
        certify(Intrinsic(pendulum(), 10.0, 50.0), recipe=recipe, progress=progress, **GIVEN)


BEAM = models.ball_and_beam()


def beam(**other) -> Lagrangian:
    names = ("potential", "force", "dissipation", "coordinates", "units", "inputs", "parameters")
    return Lagrangian(BEAM.space, **({name: getattr(BEAM, name) for name in names} | other))


@pytest.mark.parametrize(
    ("model", "said"),
    [
        (beam(coordinates=BEAM.coordinates[::-1]), "coordinates are"),
        (beam(units=("rad", "rad")), "units are"),
        (beam(potential=lambda q: BEAM.potential(q) * (1 + 1e-15)), "the force differs"),
        (beam(force=lambda t, q, u: BEAM.force(t, q, u) + 0.0 * q + 1e-9), "the force differs"),
        (beam(dissipation=lambda q, v: -1e-9 * v), "the friction differs"),
    ],
)
def test_another_model_with_the_same_parameters_is_refused(model, said):
    recipe = {"system": "ball_and_beam"}
    given = {"velocity": 0.2, "error": 0.02, "position": ([-0.2, -0.2], [0.2, 0.2])}
    with pytest.raises(ValueError, match=said):
        certify(Intrinsic(model, 10.0, 50.0), recipe=recipe, **given)
    if said == "the force differs":
        with pytest.raises(ValueError, match=said):
            certify_globally(model, velocity=0.2, position=given["position"], interval=(0.01, 0.01), recipe=recipe)


# Properties: shown, and not declared


def turned(name):
    """A left-invariant space of which one operation depends on the attitude."""

    def operation(self, x, *vectors):
        return getattr(LeftInvariant, name)(self, x, *vectors) * (1 + 0.3 * x[0, 1])

    return type(f"Turned_{name}", (LeftInvariant,), {name: operation})


def on_rotations(space) -> MechanicalSystem:
    return MechanicalSystem(space, velocities=("a", "b", "c"), velocity_units=("rad/s",) * 3)


SAMPLING = Sampling(np.array([0.01, 0.01]))
SYSTEMS = {"continuous": error_system, "sampled": lambda o, q: sampled_system(o, q, SAMPLING)}
INERTIA = jnp.diag(jnp.array([1.0, 2.0, 3.0]))
UNEVEN = {
    "matrix": Metric(lambda g: INERTIA * (1 + 0.1 * g[0, 1] ** 2), manifold=SO3),
    "energy": KineticEnergy(lambda g, v: v @ INERTIA @ v / 2 + 0.1 * (g[2, 2] * v[0]) ** 2, manifold=SO3),
}


@pytest.mark.core(6)
@pytest.mark.parametrize("time", SYSTEMS)
@pytest.mark.parametrize("name", [*_properties.OF_SPACES, *UNEVEN])
def test_a_space_that_depends_on_the_attitude_is_refused(name, time):
    space = UNEVEN[name] if name in UNEVEN else turned(name)(SO3, INERTIA)
    with pytest.raises(ValueError, match="depends on where the body is"):
        SYSTEMS[time](Intrinsic(on_rotations(space), 10.0, 50.0), np.eye(2))


def test_every_operation_of_a_space_is_among_those_that_are_shown():
    """What a space has, less what follows from these operations or is for exact observers alone."""
    derived = {"gram", "coriolis_matrix", "shoot", "transport_along", "manifold"}
    public = {name for name in vars(AbstractSpace) if not name.startswith("_")}
    assert public - derived - {*_properties.IDENTITIES} == {*_properties.OF_SPACES}


@pytest.mark.core(1)
@pytest.mark.parametrize("group", [lie.SO2, lie.SO3, lie.SE2, lie.SE3, lie.Product((lie.SO3, lie.SO2))], ids=str)
def test_left_invariant_spaces_are_the_same_everywhere(group):
    need_symmetry(GroupSystem(group, jnp.diag(jnp.arange(1.0, 1.0 + group.dimension))))


CIRCLES = [pendulum(), models.pendulum_chain(), models.pendulum_chain(angles="absolute")]
CIRCLES += [Lagrangian(lambda q: jnp.eye(1), lambda q: jnp.cos(1 - 2 * q[0]), circles=(0,), coordinates=("q",))]


@pytest.mark.core(1)
@pytest.mark.parametrize("model", [*CIRCLES, "double_pendulum", "scara"])
def test_circles_of_models_are_circles(model):
    need_known(models.load(model).model)


def on_a_circle(metric=lambda q: jnp.eye(1), **functions) -> Lagrangian:
    return Lagrangian(metric, **functions, circles=(0,), coordinates=("x",), units=("m",))


NO_CIRCLES = {
    "spring": (on_a_circle(potential=lambda q: q[0] ** 2), "force"),
    "half of the angle": (on_a_circle(potential=lambda q: jnp.cos(q[0] / 2)), "force"),
    "nearly twice the angle": (on_a_circle(potential=lambda q: jnp.cos((2 + 1e-15) * q[0])), "force"),
    "input that grows": (on_a_circle(force=lambda t, q, u: u * (1 + q)), "force"),
    "friction behind a stop": (on_a_circle(dissipation=lambda q, v: -v * jnp.where(q > 1, 2.0, 1.0)), "friction"),
    "mass that grows": (on_a_circle(lambda q: (2 + jnp.tanh(q[0])) * jnp.eye(1)), "metric"),
    "force where it is defined": (on_a_circle(potential=lambda q: 0 * jnp.sqrt(4 - q[0])), "force"),
}


@pytest.mark.parametrize("name", NO_CIRCLES)
def test_a_length_is_no_circle(name):
    model, part = NO_CIRCLES[name]
    with pytest.raises(ValueError, match=f"x is called a circle, but the {part} of this model is not shown"):
        certify(Intrinsic(model, 10.0, 50.0), **GIVEN)
    # An angle that is not called a circle is only less convenient.
    straight = Lagrangian(model.space.matrix, model.potential, model.force, model.dissipation, coordinates=("x",))
    need_known(straight)


class Wrapped(Coordinates):
    """Coordinates in which an error counts twice."""

    def towards(self, x, y):
        return 2 * super().towards(x, y)


class Slipping(type(SO3)):
    """Rotations whose retraction depends on the attitude."""

    def retract(self, x, s):
        return super().retract(x, s * (1 + 0.1 * x[0, 1]))


class Unwound(Lagrangian):
    """A system that says that it has no circles."""

    @property
    def circles(self):
        return ()


@pytest.mark.parametrize(
    ("model", "said"),
    [
        (MechanicalSystem(Metric(lambda q: jnp.eye(1), manifold=Wrapped((), 1)), coordinates=("x",)), "Wrapped"),
        (GroupSystem(Slipping(), INERTIA), "Slipping"),
        (GroupSystem(lie.Product((Slipping(), lie.SO2)), jnp.eye(4)), "Slipping"),
        (Unwound(lambda q: jnp.eye(1), circles=(0,), coordinates=("x",)), "Unwound"),
    ],
)
def test_manifolds_and_systems_of_other_classes_are_refused(model, said):
    for system in SYSTEMS.values():
        with pytest.raises(ValueError, match=said):
            system(Intrinsic(model, 10.0, 50.0), np.eye(2))


def test_a_model_that_is_refused_has_no_certificate_of_all_first_errors():
    model = Lagrangian(BEAM.space, lambda q: BEAM.potential(q) + q[1] ** 2, circles=(1,), coordinates=("r", "theta"))
    with pytest.raises(ValueError, match="theta is called a circle"):
        certify_globally(model, velocity=1.0, position=([-2, -4], [2, 4]), interval=(0.01, 0.01))


# Nothing tried is nothing proved


@pytest.mark.parametrize("seconds", [1e-17, 1e-9, 1e-7])
@pytest.mark.parametrize("rate", [1.9, 0.0, -1.0])
def test_distances_over_no_time_show_no_rate(seconds, rate):
    t, shrink = np.linspace(0.0, seconds, 5), np.exp(-np.linspace(0.0, seconds, 5))
    distance = shrink[None] * np.ones((2, 1))
    assert Decay(t, distance, distance, np.exp(-rate / 2 * t)[None] * np.ones((2, 1))).statement.verdict == "undecided"
    assert Decay(t[:1], *(each[:, :1] for each in [distance] * 3)).statement.verdict == "undecided"


def test_nothing_is_tried_without_points_or_errors():
    system = error_system(Intrinsic(models.oscillator(), 10.0, 50.0), np.eye(2))
    around = box(q=(-1.0, 1.0), v=(-1.0, 1.0), e=(-0.1, 0.1), f=(0.0, 0.0))
    with pytest.raises(ValueError, match="a single point"):
        falsify(system, around._replace(low=np.zeros(4), high=np.zeros(4)), -100.0)


# Words of evidence


@pytest.mark.parametrize("word", ["guessed", "Proved", "proved ", "", None, ("proved",)])
def test_evidence_is_a_closed_set(word):
    with pytest.raises(ValueError, match="evidence must be one of proved, sampled, claimed, assumed; got"):
        Hypothesis("it holds", word)
    with pytest.raises(ValueError, match="verdict must be one of holds, fails, undecided; got"):
        Hypothesis("it holds", "proved", word)
    held = Hypothesis("it holds", "proved")
    for name in ("evidence", "verdict"):
        with pytest.raises(ValueError, match=f"{name} must be one of"):
            dataclasses.replace(held, **{name: word})
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(held, name, word)


def test_no_margin_that_is_no_number_holds():
    with pytest.raises(ValueError, match="cannot hold by a margin that is not a number"):
        Hypothesis("it holds", "sampled", margin=np.nan)
    assert Hypothesis("it fails", "sampled", "fails", np.nan).verdict == "fails"
