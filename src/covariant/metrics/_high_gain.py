"""The metric of the high-gain observer, with which this observer becomes a Riccati observer."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from covariant._typing import Matrix, MatrixField, Number, Vector
from covariant.metrics._equation import model_input
from covariant.models import StateSpace


def high_gain(model: StateSpace, rate: Number) -> MatrixField:
    """The metric of the high-gain observer, for a model with one output.

    It solves equation (15) for a chain of integrators, pulled back by the map `x -> (h, L_f h, …, L_f^{n−1} h)` from
    the state to the derivatives of the output. Use it in `observers.Riccati` with gain ½: for a chain of integrators
    all poles of the observer are at −rate, and the other terms of a model are dominated where the rate is large enough.
    Where the map is singular, so is the metric. Source: Gauthier, Hammouri & Othman 1992, A simple observer for
    nonlinear systems.
    """
    if len(model.outputs) > 1:
        raise ValueError(f"high_gain is for one output; the model has {len(model.outputs)}: {', '.join(model.outputs)}")

    def metric(x: Vector) -> Matrix:
        n = x.shape[0]
        input_held, t0 = model_input(model, None, x.dtype), jnp.zeros((), x.dtype)

        def derivatives(y):
            functions = [lambda z: model.h(t0, z, input_held)[0]]
            for _ in range(n - 1):
                functions.append(lambda z, last=functions[-1]: jax.jvp(last, (z,), (model.f(t0, z, input_held),))[1])
            return jnp.stack([function(y) for function in functions])

        jacobian = jax.jacfwd(derivatives)(x)
        order = np.arange(n)
        binomial = np.array([[math.comb(i + j, j) for j in order] for i in order])
        signed = jnp.asarray(binomial * (-1.0) ** (order[:, None] + order), x.dtype)
        chain = signed / jnp.asarray(rate, x.dtype) ** jnp.asarray(order[:, None] + order + 1, x.dtype)
        return jacobian.T @ chain @ jacobian

    return metric
