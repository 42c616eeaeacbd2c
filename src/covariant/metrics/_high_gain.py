"""Computes the metric for which a Riccati observer is the high-gain observer."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from covariant._typing import Matrix, MatrixField, Number, Vector
from covariant.metrics._equation import model_input
from covariant.models import StateSpace
from scalargraph.errors import InputError


def high_gain(model: StateSpace, rate: Number) -> MatrixField:
    """Metric of the high-gain observer, for a model with one output.

    It solves equation (15) for a chain of integrators, pulled back by the map `x -> (h, L_f h, …, L_f^{n−1} h)` from
    the state to the derivatives of the output. Use it in `observers.Riccati` with gain ½: for a chain of integrators
    all poles of the observer are at −rate, and a sufficiently large rate dominates the other terms of a model. If the
    map is singular, so is the metric. Source: Gauthier, Hammouri & Othman 1992, A simple observer for nonlinear
    systems.

    Args:
        model: system with one output; its input is taken as zero.
        rate: λ [1/s].

    Returns:
        The metric as a function `x (n,) -> (n, n)`.

    Raises:
        ValueError: the model has more than one output.

    Example:
        The double integrator:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics import high_gain
        >>> from covariant.models import StateSpace
        >>> model = StateSpace(lambda t, x, u: jnp.stack([x[1], 0.0 * x[0]]), lambda t, x, u: x[:1])
        >>> high_gain(model, rate=1.0)(jnp.zeros(2)).tolist()
        [[1.0, -1.0], [-1.0, 2.0]]
    """
    if len(model.outputs) > 1:
        raise InputError(f"high_gain is for one output; the model has {len(model.outputs)}: {', '.join(model.outputs)}")

    def metric(x: Vector) -> Matrix:
        n = x.shape[0]
        input_held, t0 = model_input(model, None, x.dtype), jnp.zeros((), x.dtype)

        def derivatives(y):
            functions = [lambda z: model.h(t0, z, input_held)[0]]
            for _ in range(n - 1):
                # The default argument binds the current derivative; a closure would refer to the last one of the list.
                functions.append(lambda z, last=functions[-1]: jax.jvp(last, (z,), (model.f(t0, z, input_held),))[1])
            return jnp.stack([function(y) for function in functions])

        # The map turns the model into a chain of integrators; its Jacobian pulls back the metric of this chain.
        jacobian = jax.jacfwd(derivatives)(x)
        order = np.arange(n)
        binomial = np.array([[math.comb(i + j, j) for j in order] for i in order])
        signed = jnp.asarray(binomial * (-1.0) ** (order[:, None] + order), x.dtype)
        # (−1)^{i+j} C(i+j, j) / λ^{i+j+1}: the solution of (15) for a chain of n integrators.
        chain = signed / jnp.asarray(rate, x.dtype) ** jnp.asarray(order[:, None] + order + 1, x.dtype)
        return jacobian.T @ chain @ jacobian

    return metric
