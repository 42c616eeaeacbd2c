"""The laws every group keeps, logarithms on both sides of half a turn and at it, membership, quaternions, and refusals.

The laws are written once, as pairs of equal expressions of a sample, and hold for all groups.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry import lie

SL2 = [[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [0.0, 0.0]], [[0.0, 0.0], [1.0, 0.0]]]
TURNS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]]
)
CYCLIC = np.linalg.det(np.eye(3)[np.stack(np.meshgrid(*[range(3)] * 3, indexing="ij"), -1)])
"""The structure constants of the cross product."""

GROUPS = {
    "SO2": lie.SO2,
    "SO3": lie.SO3,
    "SE2": lie.SE2,
    "SE3": lie.SE3,
    "SU2": lie.SU(2),
    "SU3": lie.SU(3),
    "SO3 x SO2": lie.Product((lie.SO3, lie.SO2)),
    "SL2": lie.MatrixGroup(SL2),
    "SO3 from its basis": lie.MatrixGroup(TURNS, CYCLIC),
    "SU2 from its basis": lie.MatrixGroup(jax.vmap(lie.SU(2).hat)(jnp.eye(3))),
}


def close(a, b, tolerance=1e-13):
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, np.abs(b).max()))


# Laws


class Together:
    """A group's operations on batches, each compiled once."""

    def __init__(self, group):
        self.group, self.compiled = group, {}
        self.one = np.asarray(group.identity())

    def __getattr__(self, name):
        if name not in self.compiled:
            self.compiled[name] = jax.jit(jax.vmap(getattr(self.group, name)))
        return self.compiled[name]

    def derivative(self, name, at, along):
        operation, key = getattr(self.group, name), f"derivative of {name}"
        if key not in self.compiled:
            self.compiled[key] = jax.jit(jax.vmap(lambda x, y: jax.jvp(operation, (x,), (y,))[1]))
        return self.compiled[key](at, along)


class Sample(NamedTuple):
    """Vectors of the algebra, a momentum, and elements."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    mu: np.ndarray
    g: np.ndarray
    h: np.ndarray
    k: np.ndarray


def dot(a, b):
    return np.einsum("ki,ki->k", a, b)


LAWS = {
    "associative": lambda G, s: (G.compose(G.compose(s.g, s.h), s.k), G.compose(s.g, G.compose(s.h, s.k))),
    "neutral": lambda G, s: (G.one @ s.g @ G.one, s.g),
    "inverse": lambda G, s: (G.inverse(s.g) @ s.g, G.one),
    "inverse of a product": lambda G, s: (G.inverse(s.g @ s.h), G.inverse(s.h) @ G.inverse(s.g)),
    "inverse of exp": lambda G, s: (G.exp(-s.x), G.inverse(G.exp(s.x))),
    "exp of zero": lambda G, s: (G.exp(0 * s.x), G.one),
    "one-parameter group": lambda G, s: (G.exp(0.3 * s.x) @ G.exp(0.7 * s.x), G.exp(s.x)),
    "exp starts along hat": lambda G, s: (G.derivative("exp", 0 * s.x, s.x), G.hat(s.x)),
    "vee undoes hat": lambda G, s: (G.vee(G.hat(s.x)), s.x),
    "log undoes exp": lambda G, s: (G.log(G.exp(s.x)), s.x),
    "bracket": lambda G, s: (G.hat(G.lie_bracket(s.x, s.y)), G.hat(s.x) @ G.hat(s.y) - G.hat(s.y) @ G.hat(s.x)),
    "antisymmetry": lambda G, s: (G.lie_bracket(s.x, s.y), -G.lie_bracket(s.y, s.x)),
    "Jacobi's identity": lambda G, s: (
        G.lie_bracket(s.x, G.lie_bracket(s.y, s.z)) + G.lie_bracket(s.y, G.lie_bracket(s.z, s.x)),
        G.lie_bracket(G.lie_bracket(s.x, s.y), s.z),
    ),
    "Ad": lambda G, s: (G.hat(G.adjoint(s.g, s.x)), s.g @ G.hat(s.x) @ G.inverse(s.g)),
    "Ad of a bracket": lambda G, s: (
        G.adjoint(s.g, G.lie_bracket(s.x, s.y)),
        G.lie_bracket(G.adjoint(s.g, s.x), G.adjoint(s.g, s.y)),
    ),
    "Ad of a product": lambda G, s: (G.adjoint(s.g @ s.h, s.x), G.adjoint(s.g, G.adjoint(s.h, s.x))),
    "exp of Ad": lambda G, s: (G.exp(G.adjoint(s.g, s.x)), s.g @ G.exp(s.x) @ G.inverse(s.g)),
    "ad* pairs": lambda G, s: (dot(G.coadjoint(s.x, s.mu), s.y), dot(s.mu, G.lie_bracket(s.x, s.y))),
    "Ad* pairs": lambda G, s: (dot(G.coadjoint_action(s.g, s.mu), s.y), dot(s.mu, G.adjoint(s.g, s.y))),
    "body velocity": lambda G, s: (G.exp(s.x) @ G.hat(G.right_jacobian(s.x, s.y)), G.derivative("exp", s.x, s.y)),
    "spatial velocity": lambda G, s: (G.hat(G.left_jacobian(s.x, s.y)) @ G.exp(s.x), G.derivative("exp", s.x, s.y)),
    "Ad leads from body to space": lambda G, s: (
        G.left_jacobian(s.x, s.y),
        G.adjoint(G.exp(s.x), G.right_jacobian(s.x, s.y)),
    ),
    "Jacobian along itself": lambda G, s: (G.right_jacobian(s.x, s.x), s.x),
    "right inverse": lambda G, s: (G.right_jacobian_inverse(s.x, G.right_jacobian(s.x, s.y)), s.y),
    "left inverse": lambda G, s: (G.left_jacobian_inverse(s.x, G.left_jacobian(s.x, s.y)), s.y),
    "derivative of log": lambda G, s: (
        G.derivative("log", G.exp(s.x), G.exp(s.x) @ G.hat(s.y)),
        G.right_jacobian_inverse(s.x, s.y),
    ),
    "between": lambda G, s: (G.between(s.g, s.g @ G.exp(s.x)), s.x),
    "no defect": lambda G, s: (G.defect(s.g @ s.h), 0.0),
    "short logarithms are unique": lambda G, s: (G.unique_log(G.exp(s.x)), True),
}


@pytest.fixture(scope="module", params=["SO2", "SO3", "SE2", "SE3", "SU3", "SO3 x SO2", "SL2"])
def sampled(request) -> tuple[Together, Sample]:
    group = Together(GROUPS[request.param])
    x, y, z, mu, *seeds = np.random.default_rng(0).normal(size=(7, 12, group.group.dimension))
    x *= (np.linspace(0, 2, 12) / np.linalg.norm(x, axis=1))[:, None]
    return group, Sample(x, y, z, mu, *(np.asarray(group.exp(0.4 * seed)) for seed in seeds))


@pytest.mark.core(3)
@pytest.mark.exhaustive("SL2-between", "SL2-derivative of log", "SL2-no defect", "SU3")
@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_law(sampled, law):
    mine, theirs = map(np.asarray, law(*sampled))
    close(mine, np.broadcast_to(theirs, mine.shape))


@pytest.mark.core(2)
@pytest.mark.exhaustive("SU3")
def test_act_is_an_action(sampled):
    group, s = sampled
    if group.group is GROUPS["SO3 x SO2"]:
        return
    points = s.k[:, 0, : len(group.one) - isinstance(group.group, type(lie.SE2) | type(lie.SE3))]
    close(group.act(s.g @ s.h, points), group.act(s.g, np.asarray(group.act(s.h, points))))
    close(group.act(np.broadcast_to(group.one, s.g.shape), points), points)


def test_a_product_has_no_space_of_its_own():
    group = GROUPS["SO3 x SO2"]
    with pytest.raises(NotImplementedError, match="blocks"):
        group.act(group.identity(), jnp.ones(5))


def test_a_product_comes_apart():
    group = GROUPS["SO3 x SO2"]
    x = jnp.array([0.1, -0.2, 0.3, 0.7])
    for block, part, factor in zip(group.blocks(group.exp(x)), group.parts(x), group.groups, strict=True):
        np.testing.assert_array_equal(block, factor.exp(part))
    np.testing.assert_array_equal(group.join(group.blocks(group.exp(x))), group.exp(x))


@pytest.mark.core(4)
@pytest.mark.exhaustive("SU3")
@pytest.mark.parametrize("name", GROUPS)
def test_float32_stays_float32(name):
    group = GROUPS[name]

    def everything(x):
        g = group.exp(x)
        elements = g, group.hat(x), group.inverse(g), group.identity(np.float32)
        of_vectors = ("lie_bracket", "right_jacobian", "right_jacobian_inverse", "left_jacobian", "coadjoint")
        vectors = [getattr(group, name)(x, x) for name in of_vectors]
        return (
            elements,
            vectors,
            group.log(g),
            group.vee(g),
            group.adjoint(g, x),
            group.coadjoint_action(g, x),
            group.defect(g),
        )

    results = jax.tree.leaves(jax.eval_shape(everything, jax.ShapeDtypeStruct((group.dimension,), np.float32)))
    assert {np.finfo(a.dtype).dtype for a in results} == {np.dtype(np.float32)}


# Logarithms

AXES = np.array([
    [1, 0, 0], [0, -1, 0], [0, 0, -1], [1, 1, 0], [0, -1, 1], [-1, -1, -1], [3, -2, 1], [-0.3, 0.1, 0.9],
    [-1, 1e-9, 0], [1, -1e-5, -1e-200], [1e-17, 1, -1], [1e-4, -1e-4, 1], [-1e-8, 0, 1e-8], [0.5, 0.5, -0.7071],
])  # fmt: skip


@pytest.mark.core(4)
@pytest.mark.exhaustive("axis0")
@pytest.mark.parametrize("axis", AXES)
def test_log_of_an_exact_half_turn_is_along_its_axis(axis):
    """Built from the axis alone, so that not even the antisymmetric part's sign is left."""
    unit = axis / np.linalg.norm(axis)
    g = jnp.asarray(2 * np.outer(unit, unit) - np.eye(3))
    x = np.asarray(lie.SO3.log(g))
    close(np.linalg.norm(x), np.pi, 1e-15)
    close(np.cross(x, unit), 0, 1e-14)
    close(lie.SO3.exp(jnp.asarray(x)), g, 4e-15)
    assert not lie.SO3.unique_log(g)


# Membership


@pytest.mark.core(2)
@pytest.mark.exhaustive("SL2", "SU3")
@pytest.mark.parametrize("name", ["SO2", "SO3", "SE2", "SE3", "SU3", "SO3 x SO2", "SL2"])
def test_what_is_no_element_is_refused(name):
    group = GROUPS[name]
    contains = jax.jit(jax.vmap(lambda g: group.contains(g, 1e-6)))
    one = group.identity()
    nothing = jnp.full_like(one, np.nan)
    flip = jnp.diag(jnp.ones(group.order).at[0].set(-1.0)).astype(one.dtype)
    assert contains(jnp.stack([one, 1.01 * one, flip, one.at[0, 0].set(np.nan), nothing])).tolist() == [True] + 4 * [
        False
    ]


@pytest.mark.parametrize("name", ["SE2", "SE3"])
def test_the_last_row_of_a_motion_is_fixed(name):
    group = GROUPS[name]
    one = group.identity()
    assert group.contains(one.at[0, -1].set(1e3), 1e-12)
    assert not group.contains(one.at[-1, 0].set(1e-3), 1e-6)
    assert not group.contains(one.at[0, -1].set(np.inf), 1e-6)


def test_what_a_product_leaves_between_its_blocks_is_zero():
    group = GROUPS["SO3 x SO2"]
    assert not group.contains(group.identity().at[0, 4].set(1e-3), 1e-6)


# Quaternions


@pytest.fixture(scope="module")
def quaternions():
    q = np.random.default_rng(4).normal(size=(40, 4))
    q[:4], q[4:8, 0], q[8:12, 1:] = np.eye(4), 0.0, 1e-9 * q[8:12, 1:]
    return q / np.linalg.norm(q, axis=1)[:, None]


to_rotation = jax.jit(jax.vmap(lie.rotation_from_quaternion))
to_quaternion = jax.jit(jax.vmap(lie.quaternion_from_rotation))


def test_quaternion_round_trip(quaternions):
    again = to_quaternion(to_rotation(quaternions))
    assert (again[:, 0] >= 0).all()
    close(np.abs(np.einsum("ki,ki->k", again, quaternions)), np.ones(40), 1e-15)
    close(to_rotation(again), to_rotation(quaternions), 2e-15)


def test_a_quaternion_of_either_sign_and_any_length_is_the_same_rotation(quaternions):
    close(to_rotation(-quaternions), to_rotation(quaternions), 0)
    close(to_rotation(3.7 * quaternions), to_rotation(quaternions), 1e-15)
    assert jax.vmap(lambda g: lie.SO3.contains(g, 1e-15))(to_rotation(1e-3 * quaternions)).all()


def test_quaternion_of_a_known_turn():
    """Scalar first: a quarter turn about z."""
    expected = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    close(lie.quaternion_from_rotation(lie.SO3.exp(jnp.array([0, 0, np.pi / 2]))), expected, 1e-15)


# The basis of SU(n)


@pytest.mark.parametrize("n", [2, 4])
def test_basis_of_su_is_gell_manns(n):
    """Traceless, skew, and of one length: tr(e_i e_j) = −½ δ_ij."""
    basis = np.asarray(jax.vmap(lie.SU(n).hat)(jnp.eye(n**2 - 1)))
    close(np.einsum("iab,jba->ij", basis, basis), -0.5 * np.eye(n**2 - 1), 1e-15)
    close(basis, -basis.conj().swapaxes(1, 2), 0)


# Refusals


@pytest.mark.parametrize("n", [1, 0, -3])
def test_su_needs_two_dimensions(n):
    with pytest.raises(ValueError, match="2 or more"):
        lie.SU(n)


def test_a_product_needs_a_group():
    with pytest.raises(ValueError, match="at least one group"):
        lie.Product(())


@pytest.mark.parametrize(
    ("basis", "structure", "word"),
    [
        (np.ones((2, 3)), None, "shape"),
        (np.ones((2, 3, 2)), None, "shape"),
        (np.ones((0, 2, 2)), None, "shape"),
        ([*SL2, SL2[0]], None, "dependent"),
        (SL2[1:], None, "not closed"),
        (np.stack([np.eye(2), 1j * np.array(SL2[1]), np.array(SL2[2])]), None, "not closed"),
        (TURNS, -CYCLIC, "structure constants"),
        (TURNS, CYCLIC[:2], "structure constants"),
    ],
)
def test_a_matrix_group_names_what_is_wrong(basis, structure, word):
    with pytest.raises(ValueError, match=word):
        lie.MatrixGroup(basis, structure)
