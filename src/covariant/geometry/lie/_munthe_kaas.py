"""Differential equations on a group, integrated in its algebra so that the solution stays on it by construction.

Source: Munthe-Kaas 1998, Runge–Kutta methods on Lie groups.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from covariant._integrate import rk4_step
from covariant._typing import Element
from covariant.geometry.lie._group import AbstractGroup

GroupFlow = Callable[[Any, Element, Any], tuple[Any, Any]]
"""A vector field `(t, g, x) -> (body velocity (n,), dx/dt)` over a group and any pytree x beside it."""


def munthe_kaas(group: AbstractGroup, flow: GroupFlow, t, g: Element, x, dt, steps, rule=rk4_step):
    """Advance (g, x) by `dt` in `steps` equal steps; a Python int is static, a traced count is not.

    Each step solves for the exponential coordinates of the motion since its start, by `rule`: a one-step method
    `(flow, t, x, dt) -> x` of `covariant._integrate`, of whose order the result is.
    """
    real = group.vee(g).dtype
    h = dt / jnp.asarray(steps, real)

    def local(start):
        def flow_of_coordinates(s, joint):
            sigma, beside = joint
            velocity, slope = flow(s, start @ group.exp(sigma), beside)
            return group.right_jacobian_inverse(sigma, velocity), slope

        return flow_of_coordinates

    def step(i, joint):
        g, x = joint
        sigma = jnp.zeros(group.dimension, real)
        sigma, x = rule(local(g), t + jnp.asarray(i, real) * h, (sigma, x), h)
        return g @ group.exp(sigma), x

    return jax.lax.fori_loop(0, steps, step, (g, x))
