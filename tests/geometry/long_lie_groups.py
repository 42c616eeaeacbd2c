"""What takes long of `test_lie_groups.py`."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_lie_groups import AXES, GROUPS, close

from covariant.geometry import lie

PRECISIONS = [np.float64, np.float32]


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["SO3", "SU2"])
def test_log_has_a_gradient(name):
    """Backwards too, however the logarithm is found."""
    group = GROUPS[name]
    x, y, mu = 0.4 * np.random.default_rng(9).normal(size=(3, group.dimension))

    def both(x, y, mu):
        gradient = jax.grad(lambda e: mu @ group.log(group.exp(x) @ group.exp(e)))(jnp.zeros_like(x))
        return gradient @ y, mu @ group.right_jacobian_inverse(x, y)

    close(*jax.jit(both)(x, y, mu))


GAPS = np.concatenate([10.0 ** np.arange(-15, -2), [0]])


ANGLES = np.concatenate(
    [[0, 1e-12, 1e-8, 1e-4, 1, 2, 3, 4, 6], 2 * np.arctan(0.1) + [-1e-6, 1e-6], np.pi - GAPS, np.pi + GAPS]
)


def rotation_vectors():
    units = AXES / np.linalg.norm(AXES, axis=1)[:, None]
    return (ANGLES[:, None, None] * units).reshape(-1, 3)


def with_translations(omega, n):
    return np.concatenate([np.random.default_rng(2).normal(size=(len(omega), n)), omega], axis=1)


def su3_vectors():
    """Turns in three subgroups SU(2), whose cut locus is at 2π, turned about; and vectors of any length below 12."""
    rng = np.random.default_rng(3)
    single = np.repeat(np.eye(8)[[0, 4, 6]], len(ANGLES), 0) * 2 * np.tile(ANGLES, 3)[:, None]
    turned = jax.vmap(lambda a, x: lie.SU(3).adjoint(lie.SU(3).exp(a), x))(rng.normal(size=single.shape), single)
    others = rng.normal(size=(60, 8))
    return np.concatenate([single, turned, others * (np.linspace(0, 12, 60) / np.linalg.norm(others, axis=1))[:, None]])


SEAMS = {
    "SO2": lambda: ANGLES[:, None],
    "SO3": rotation_vectors,
    "SE2": lambda: with_translations(np.tile(ANGLES, 4)[:, None], 2),
    "SE3": lambda: with_translations(rotation_vectors(), 3),
    "SU3": su3_vectors,
    "SO3 x SO2": lambda: np.concatenate([rotation_vectors(), rotation_vectors()[::-1, :1]], axis=1),
}


@cache
def seam(name):
    x = SEAMS[name]()
    return x, np.asarray(jax.jit(jax.vmap(GROUPS[name].exp))(x))


class Logs(NamedTuple):
    """Elements, their logarithms, the exponentials of these, and whether the logarithm is the only one."""

    x: np.ndarray
    g: np.ndarray
    log: np.ndarray
    again: np.ndarray
    unique: np.ndarray
    eps: float


@pytest.fixture(scope="module", params=[(name, dtype) for name in SEAMS for dtype in PRECISIONS], ids=str)
def logs(request) -> Logs:
    name, dtype = request.param
    group = GROUPS[name]
    x, g = seam(name)
    g = g.astype(np.result_type(dtype, np.complex64) if np.iscomplexobj(g) else dtype)

    def everything(g):
        x = group.log(g)
        return x, group.exp(x), group.unique_log(g)

    return Logs(x, g, *(np.asarray(a) for a in jax.jit(jax.vmap(everything))(g)), np.finfo(dtype).eps)


def largest(a):
    return np.abs(a).reshape(len(a), -1).max(axis=1)


@pytest.mark.exhaustive(
    "('SE2', <class 'numpy.float64'>)",
    "('SE3', <class 'numpy.float32'>)",
    "('SE3', <class 'numpy.float64'>)",
    "('SO3 x SO2', <class 'numpy.float64'>)",
    "('SU3', <class 'numpy.float32'>)",
    "('SU3', <class 'numpy.float64'>)",
)
def test_log_is_backward_stable_everywhere(logs):
    assert (largest(logs.again - logs.g) / np.maximum(1, largest(logs.g))).max() <= 16 * logs.eps


@pytest.mark.exhaustive("('SU3', <class 'numpy.float32'>)", "('SU3', <class 'numpy.float64'>)")
def test_log_is_unique_but_for_the_cut_locus(request, logs):
    """Within the square root of rounding of half a turn (a whole one in SU(n)) it is called so, and not farther off."""
    name = request.node.callspec.params["logs"][0]
    x = (
        logs.x
        if name[:2] == "SO"
        else logs.x[:, -3:]
        if name == "SE3"
        else logs.x[:, -1:]
        if name == "SE2"
        else logs.x / 2
    )
    if name == "SU3":
        return
    blocks = [x[:, :3], x[:, 3:]] if name == "SO3 x SO2" else [x]
    gap = np.min([np.abs(np.linalg.norm(block, axis=1) - np.pi) for block in blocks if block.size], axis=0)
    assert not logs.unique[gap < 0.3 * logs.eps**0.5].any()
    assert logs.unique[gap > 10 * logs.eps**0.5].all()


@pytest.mark.exhaustive
def test_log_of_a_matrix_group_is_backward_stable_where_it_is_unique():
    group, (x, g) = GROUPS["SO3 from its basis"], seam("SO3")
    again, unique = jax.jit(jax.vmap(lambda g: (group.exp(group.log(g)), group.unique_log(g))))(g)
    unique, eps = np.asarray(unique), np.finfo(float).eps
    assert largest(again - g)[unique].max() <= 16 * eps
    assert unique[np.abs(np.linalg.norm(x, axis=1) - np.pi) > 10 * eps**0.5].all()


@pytest.mark.exhaustive
def test_log_is_the_shortest():
    """Where the eigenvalues' principal angles add up to a whole turn, SU(3) still finds a traceless logarithm."""
    group = lie.SU(3)
    angles = np.array([2.5, 2.4, 2 * np.pi - 4.9])
    x = group.log(jnp.asarray(np.diag(np.exp(1j * angles))))
    close(group.hat(x), np.diag(1j * (angles - [2 * np.pi, 0, 0])), 1e-14)


@pytest.mark.exhaustive
@pytest.mark.parametrize("sign", [1, -1])
def test_a_logarithm_is_traceless_also_where_the_angles_add_up_to_two_turns(sign):
    group = lie.SU(5)
    angles = sign * np.array([2.3, 2.4, 2.5, 2.6, 4 * np.pi - 9.8])
    x = group.log(jnp.asarray(np.diag(np.exp(1j * angles))))
    shortest = angles - sign * 2 * np.pi * np.array([0, 0, 0, 1, 1])
    close(group.hat(x), np.diag(1j * shortest), 1e-14)


@pytest.mark.exhaustive
def test_half_turns_have_two_logarithms():
    half = jnp.diag(jnp.array([-1.0, -1.0, 1.0]))
    assert not lie.SO2.unique_log(half[:2, :2])
    assert not lie.SE2.unique_log(half.at[0, 2].set(3.0))
    assert not lie.SE3.unique_log(jax.scipy.linalg.block_diag(half, jnp.eye(1)).at[0, 3].set(3.0))
    assert not lie.SU(2).unique_log(-lie.SU(2).identity())
    assert not lie.SU(3).unique_log(half.astype(complex))
    assert not GROUPS["SO3 from its basis"].unique_log(half)
    assert not GROUPS["SO3 x SO2"].unique_log(jax.scipy.linalg.block_diag(jnp.eye(3), half[:2, :2]))


@pytest.mark.exhaustive
def test_a_basis_of_rounded_numbers_is_closed():
    basis = jax.vmap(lie.SU(3).hat)(jnp.eye(8, dtype=np.float32))
    assert lie.MatrixGroup(basis).dimension == 8
