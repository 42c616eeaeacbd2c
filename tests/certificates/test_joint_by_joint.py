"""Bounds of the inertia and the coupling of an arm joint by joint hold at random configurations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import certify_globally
from covariant.certificates.everywhere import _certify, _chain

LINK = """<link name="{name}"><inertial><origin xyz="{place}"/><mass value="{mass}"/>
<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0.0004" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{place}" rpy="{turned}"/><axis xyz="{axis}"/>
<limit lower="{low}" upper="{high}" effort="9" velocity="9"/></joint>"""


def link(name, mass, place, moments):
    ixx, iyy, izz = moments
    return LINK.format(name=name, mass=mass, place=place, ixx=ixx, iyy=iyy, izz=izz)


def joint(name, kind, parent, child, place, turned, axis, low, high):
    return JOINT.format_map(locals())


def branching(folder):
    """The recipe of a turning post that carries a turning arm with a slide at its end, and a second, tilted arm."""
    parts = [
        '<link name="base"/>',
        link("post", 2.0, "0.02 0 0.2", (0.03, 0.03, 0.01)),
        link("arm", 1.0, "0.2 0 0.01", (0.004, 0.02, 0.02)),
        link("slide", 0.3, "0.05 0.01 0", (0.002, 0.003, 0.003)),
        link("other", 0.7, "0 0.15 0", (0.01, 0.003, 0.01)),
        joint("q1", "revolute", "base", "post", "0 0 0.1", "0 0 0", "0 0 1", -3, 3),
        joint("q2", "revolute", "post", "arm", "0.1 0 0.4", "0.3 0 0", "0 1 0", -1.5, 1.5),
        joint("q3", "prismatic", "arm", "slide", "0.4 0 0", "0 0.2 0", "1 0 0", -0.1, 0.2),
        joint("q4", "revolute", "post", "other", "-0.1 0 0.4", "0 0.7 0.2", "0.6 0 0.8", -2, 2),
    ]
    path = folder / "arm.urdf"
    path.write_text('<robot name="arm">' + "\n".join(parts) + "</robot>", encoding="utf-8")
    return models.recipe("robot", {"parameters.path": str(path), "parameters.armature": {"q2": 0.05, "q4": 0.02}})


def certified(recipe):
    """Its certificate, without boxes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_certify, "FEW", 1)
        given = {"interval": (1e-3, 1e-3), "noise": 1e-5, "disturbance": 0.1, "recipe": recipe}
        return certify_globally(models.from_recipe(recipe), velocity=[1.0, 1.5, 0.5, 2.0], **given)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return certified(branching(tmp_path_factory.mktemp("arm")))


@pytest.mark.core(15)
def test_the_bounds_hold_at_random_configurations(made):
    model, document = made.observer.model, made.document
    assert made.statement.proved
    assert not document.levels
    chain, inertia = _chain.Chain.of(model.space), _chain.InertiaBounds.of(document.inertia)
    rng, n = np.random.default_rng(1), 4
    q = jnp.asarray(rng.uniform(document.low, document.high, (3000, n)))
    metric = np.asarray(jax.vmap(model.space)(q))
    assert np.linalg.eigvalsh(metric - np.diag(inertia.least)).min() > 0
    alone = np.diagonal(metric, axis1=1, axis2=2) - [0.0, 0.05, 0.0, 0.02]
    moments = chain.moments(inertia.ceilings)
    assert (alone <= moments).all()
    assert (moments < 1.3 * alone.max(0)).all()
    w = jnp.asarray(2 * document.velocity * rng.choice([-1.0, 1.0], (3000, n)))
    z = jnp.asarray(rng.standard_normal((3000, n)))
    coupled = np.asarray(jax.vmap(model.space.connection)(q, w, z))
    size = np.sqrt((inertia.least * coupled**2).sum(1))
    bound = np.abs(np.asarray(z)) @ chain.reach(inertia.ceilings, document.velocity)
    assert (size <= bound).all()
    assert (size > 0.1 * bound).any()
    scaled = np.sqrt(((coupled / (document.weights * document.omega)) ** 2).sum(1))
    assert (scaled <= document.coupling * np.sqrt(((np.asarray(z) / document.weights) ** 2).sum(1))).all()
    pushed = np.linalg.inv(metric) @ (0.1 * rng.choice([-1.0, 1.0], n))
    assert (np.abs(pushed) <= document.acceleration).all()
