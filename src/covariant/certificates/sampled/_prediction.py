"""Bounds the errors of Runge–Kutta steps in a prediction, by a further claim of the sampled step.

Let P_s be a step of length s from a state x of the region, and f the model's vector field, with the input held. The
curve `s ↦ φ_(h−s)(P_s x)`, where φ is the exact flow, leads from the exact to the computed state after a step h. Its
velocity is `Dφ_(h−s) δ(s)`, with the defect `δ(s) = ∂_s P_s − f(P_s)`. Since φ shortens lengths, its length is at most
`∫₀^h |δ(s)|_M ds`. The step is of fourth order, so δ and its first three derivatives vanish at s = 0. With the
weights `k (s − r)^(k−1) / s^k` of Taylor's remainder, for each order k from 1 to 4,

    δ(s) = s^k · (mean of δ^(k)(r)/k! over r in [0, s])

For k = 0 the mean is δ itself. The claim is that `|δ^(k)(r)/k!|` is less than `√square` in the metric at P_s x, at all
ages, for all r and s up to the longest step. The vectors for which the matrix below is positive definite form a convex
set: if it contains the vector of each r, it contains their mean. A prediction over h in steps of length σ is then off
by at
most `h σ^k √square / (k + 1)`.
For smooth models this bound is smallest at k = 4. With steep friction, such as `atan(100 v)`, each order multiplies the
derivatives by the slope, so that near rest a lower order may give a smaller bound.

On rotations the steps act on coordinates and momentum in the chart around the start of the step.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant._typing import Scalar, Vector
from covariant.certificates.base import ANALYTIC, StateMetric, first_velocity, prediction_variables
from covariant.models import MechanicalSystem, MomentumChart, acceleration
from scalargraph import jacobian, lower
from scalargraph.proofs import Form, derivative_form
from scalargraph.proofs.checker import series

ORDER = 4
"""Order of the Runge–Kutta steps, and highest order at which derivatives of the defect are bounded."""


Jacobian = Callable[[Callable[[Array], Array], Array], Array]
"""`(function, x (n,)) -> (k, n)`."""


class Step(NamedTuple):
    """Runge–Kutta steps from one state.

    Attributes:
        state: `step length () -> state (2n,)` after the step.
        field: `state (2n,) -> rate (2n,)` of the model.
        image: `(state (2n,), jacobian) -> (2n, 2n)`, the matrix from rates to the frame of the metric. The prover and
            the checker pass their own `jacobian(function, x)`.
        gram: the metric (2n, 2n) in this frame.
    """

    state: Callable[[Scalar], Array]
    field: Callable[[Vector], Array]
    image: Callable[[Vector, Jacobian], Array]
    gram: Callable[[Vector], Array]


class Prediction(NamedTuple):
    """The steps of a prediction as functions of the variables of a box.

    Attributes:
        names, units: of the variables: configuration, velocity, force of the input, age, and two lengths of a step.
        at: `z (d,) -> Step`, which does not depend on the last two variables.
        size: number 2n of entries of a state.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    at: Callable[[Vector], Step]
    size: int

    @property
    def has_series(self) -> bool:
        """Whether the steps have derivatives of all orders."""

        def state_and_rate(r, z):
            step = self.at(z)
            return step.state(r), step.field(step.state(r))

        graph = lower(state_and_rate, jnp.zeros(()), jnp.zeros(len(self.names)), real=True).graph
        return {node.op for node in graph.nodes} <= ANALYTIC


def prediction_of(
    model: MechanicalSystem,
    n: int,
    names: tuple[str, ...],
    units: tuple[str, ...],
    metric: Callable[[Array, Scalar], StateMetric],
    configuration: Callable[[Vector], Array],
) -> Prediction:
    """Describe the steps of a prediction."""
    commuting = model.manifold.commuting
    count = first_velocity(len(names), n, sampled=True)

    def at(z):
        place, v, force = z[:count], z[count : count + n], z[count + n : count + 2 * n]
        age, still = z[count + 2 * n], jnp.zeros((), z.dtype)
        q = configuration(place)
        steps = _in_coordinates if commuting else _in_chart
        return steps(model, q, v, force, lambda x: metric(x, age), still)

    return Prediction(*prediction_variables(names, units, n), at, 2 * n)


def _runge_kutta(field: Callable[[Vector], Array], x: Vector, h: Scalar) -> Array:
    """One step of the classical method, as in `covariant._integrate` without its loop."""
    k1 = field(x)
    k2 = field(x + h / 2 * k1)
    k3 = field(x + h / 2 * k2)
    k4 = field(x + h * k3)
    # The weights are exactly 1/6 and 1/3; the program uses the nearest doubles.
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _in_coordinates(model, q, v, force, metric, still) -> Step:
    n = v.shape[0]

    @jax.jit  # traced once, not at each slope
    def field(x):
        return jnp.concatenate([x[n:], acceleration(model, still, x[:n], x[n:], force)])

    start = jnp.concatenate([q, v])
    return Step(
        lambda h: _runge_kutta(field, start, h),
        field,
        lambda x, jacobian: metric(x[:n]).coframe(still, x),
        lambda x: metric(x[:n]).gram(still, x),
    )


def _in_chart(model, g, v, force, metric, still) -> Step:
    chart, n = MomentumChart(model, g), v.shape[0]

    @jax.jit
    def field(x):
        rates, _ = chart.flow(still, (x[:n], x[n:]), lambda t, motion: force)
        return jnp.concatenate(rates)

    def image(x, jacobian):
        here = chart.motion(x[:n], x[n:])
        body = jax.vmap(functools.partial(model.manifold.frame_velocity, g, x[:n]), out_axes=1)(jnp.eye(n))
        faster = jacobian(lambda y: chart.motion(y[:n], y[n:]).v, x)
        moved = jnp.concatenate([jnp.concatenate([body, jnp.zeros((n, n))], axis=1), faster])
        return metric(here.q).coframe(still, jnp.concatenate([jnp.zeros_like(v), here.v])) @ moved

    start = jnp.concatenate([jnp.zeros_like(v), model.space.lower(g, v)])
    return Step(
        lambda h: _runge_kutta(field, start, h),
        field,
        image,
        lambda x: metric(g).gram(still, jnp.concatenate([jnp.zeros_like(v), v])),
    )


def _matrix(square: float, image: Array, gram: Array, derivative: Array) -> Array:
    """A matrix that is positive definite if a vector is shorter than `√square`, by Schur's complement."""
    pulled = gram @ (image @ derivative)
    top = jnp.concatenate([jnp.full((1,), square, gram.dtype), pulled])
    return jnp.concatenate([top[None], jnp.concatenate([pulled[:, None], gram], axis=1)])


def defect_bound(prediction: Prediction, square: float, order: int = ORDER) -> Form:
    """Build the matrix that is positive definite if `|δ^(k)(r)/k!|² < square`, with k = `order`."""

    def values(t, x, z):
        step = prediction.at(z)
        moved, there = step.state(x[0]), step.state(z[-2])
        return moved, step.field(moved), step.image(there, jacobian), step.gram(there)

    def parts(derivatives, nodes, count):
        moved, field, image, gram = nodes
        along = {1: derivatives.graph.constant(1.0)}
        rate = derivatives.along(moved, along)
        both = zip(rate.tolist(), field.tolist(), strict=True)
        defect = np.array([derivatives.graph.apply("sub", a, b) for a, b in both])
        for _ in range(order):
            defect = derivatives.along(defect, along)
        return image, gram, defect

    def whole(image, gram, derivative):
        return _matrix(square, image, gram, derivative / math.factorial(order))

    return derivative_form(values, lambda z: z[-1:], parts, whole)


def defect_matrix(
    prediction: Prediction, square: float, jacobian: Jacobian, order: int = ORDER
) -> Callable[[Array], Array]:
    """Build the same matrix from Taylor coefficients of the program, with the derivatives of the checker."""

    def matrix(z):
        step, r = prediction.at(z), z[-1]
        there = step.state(z[-2])
        moved = series(step.state, order + 1)(r)[order + 1]
        field = series(lambda h: step.field(step.state(h)), order)(r)[order]
        # (k + 1) c_(k+1) is the coefficient of the derivative.
        return _matrix(square, step.image(there, jacobian), step.gram(there), (order + 1) * moved - field)

    return matrix


def step_values(prediction: Prediction, jacobian: Jacobian) -> Callable[[Array], Array]:
    """Collect all values from which the claim is computed, to show that they are defined."""

    def parts(z):
        step = prediction.at(z)
        state = step.state(z[-1])
        pieces = state, step.field(state), step.image(state, jacobian), step.gram(state)
        return jnp.concatenate([piece.ravel() for piece in pieces])

    return parts
