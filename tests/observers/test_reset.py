"""The reset of a covariance: filters of a pose alone, whose error is written on either side, are the same filter.

A true pose is `X̂ exp(ε)` (error in the body) or `exp(ε) X̂` (error in space). Each form has its own prediction,
correction and derivative of the change of base point, J_r(δ) and J_l(δ). Source: Ge, van Goor & Mahony 2025.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry.lie import SE3, SO3

STEPS, DT = 60, 0.1
PROCESS, NOISE = 0.05, 0.1
LANDMARKS = jnp.array([[2.0, 0.3, -1.0], [-0.5, 1.5, 0.7], [0.2, -1.0, 2.0]])


def matrix(group, product, x):
    """The matrix of `y -> product(x, y)`."""
    return jax.vmap(lambda y: product(x, y), out_axes=1)(jnp.eye(group.dimension))


def estimates(group, side: str, reset: bool) -> tuple[np.ndarray, np.ndarray]:
    """Poses (STEPS, N, N) of the filter, and its covariances carried to the body."""
    n = group.dimension
    keys = jax.random.split(jax.random.key(3), 3)
    rates = jax.random.normal(keys[0], (STEPS, n))
    seen = NOISE * jax.random.normal(keys[1], (STEPS, *LANDMARKS.shape))

    def moved(pose, error):
        return pose @ group.exp(error) if side == "body" else group.exp(error) @ pose

    def view(pose):
        return jax.vmap(lambda p: group.act(group.inverse(pose), p))(LANDMARKS).ravel()

    def step(carry, sample):
        pose, cov, true = carry
        rate, noise = sample
        turn = group.exp(rate * DT)
        true, pose = true @ turn, pose @ turn
        if side == "body":
            ahead, spread = matrix(group, group.adjoint, group.inverse(turn)), jnp.eye(n)
        else:
            ahead, spread = jnp.eye(n), matrix(group, group.adjoint, pose)
        cov = ahead @ cov @ ahead.T + PROCESS**2 * DT * spread @ spread.T
        slope = jax.jacfwd(lambda e: view(moved(pose, e)))(jnp.zeros(n))
        innovation = slope @ cov @ slope.T + NOISE**2 * jnp.eye(slope.shape[0])
        gain = jnp.linalg.solve(innovation, slope @ cov).T
        change = gain @ (view(true) + noise.ravel() - view(pose))
        cov = cov - gain @ slope @ cov
        if reset:
            jacobian = group.right_jacobian if side == "body" else group.left_jacobian
            base = matrix(group, jacobian, change)
            cov = base @ cov @ base.T
        pose = moved(pose, change)
        to_body = jnp.eye(n) if side == "body" else matrix(group, group.adjoint, group.inverse(pose))
        return (pose, cov, true), (pose, to_body @ cov @ to_body.T)

    first = group.exp(0.5 * jax.random.normal(keys[2], (n,)))
    start = (group.identity(), 0.3 * jnp.eye(n), first)
    poses, covs = jax.jit(lambda: jax.lax.scan(step, start, (rates, seen))[1])()
    return np.asarray(poses), np.asarray(covs)


@pytest.mark.exhaustive
@pytest.mark.parametrize("group", [SO3, SE3], ids=["SO(3)", "SE(3)"])
def test_errors_on_either_side_give_one_filter_and_without_reset_two(group):
    apart = {}
    for reset in (True, False):
        (a, p), (b, s) = (estimates(group, side, reset) for side in ("body", "space"))
        apart[reset] = np.abs(a - b).max(), (np.abs(p - s).max(axis=(1, 2)) / np.abs(p).max(axis=(1, 2))).max()
    assert max(apart[True]) < 1e-10
    assert apart[False][0] > 1e-5
    assert apart[False][1] > 1e-2
