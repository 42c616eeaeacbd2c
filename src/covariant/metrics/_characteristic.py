"""Computes a metric by the published algorithm, back along the solution and then forward, as an independent check."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._integrate import rk8
from covariant._typing import Matrix, Number, Vector
from covariant.metrics._equation import Equation, check_state, coefficients, model_input
from covariant.models import StateSpace


class Characteristic(NamedTuple):
    """Result of the published algorithm along one characteristic.

    Attributes:
        t: time stamps (K,) [s] from −T to 0.
        x: states (K, n).
        metric: metrics (K, n, n).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.metrics._characteristic import Characteristic
        >>> path = Characteristic(t=jnp.array([-1.0, 0.0]), x=jnp.zeros((2, 1)), metric=jnp.ones((2, 1, 1)))
        >>> path.metric[-1].tolist()  # P at time 0
        [[1.0]]
    """

    t: Float[Array, "K"]
    x: Float[Array, "K n"]
    metric: Float[Array, "K n n"]


def metric_through(
    model: StateSpace,
    equation: Equation,
    x: Vector,
    length: Number,
    steps: int,
    *,
    start: Number | Matrix = 1.0,
    u: Float[Array, "m"] | None = None,
    route: Literal["riccati", "radon"] = "riccati",
) -> Characteristic:
    """Metric along the characteristic through x: steps 1 to 3 of section III of Sanfelice & Praly 2015.

    The solution is integrated backward to −T, then forward together with the metric, from π(−T) = start.

    Args:
        model: system with state x (n,) and output y (p,).
        equation: the Riccati equation.
        x: state (n,) at time 0.
        length: T [s].
        steps: number of integration steps each way.
        start: metric at −T, a matrix (n, n) or a multiple of I.
        u: constant input (m,), zero by default.
        route: "riccati" integrates π. "radon" integrates Radon's linear pair (α, β), π = α β⁻¹, of equation (10), whose
            first line must read `−f_xᵀ α + h_xᵀ h_x β`. Since the pair grows without bound, β is reset to I at every
            step.

    Returns:
        Time stamps, states and metrics.

    Raises:
        ValueError: the length of x differs from the number of states of the model.

    Example:
        For x' = −x, y = x and λ = 3 the solution is P = 1:

        >>> import jax.numpy as jnp
        >>> from covariant.metrics import Equation, metric_through
        >>> from covariant.models import StateSpace
        >>> decay = StateSpace(lambda t, x, u: -x, lambda t, x, u: x)
        >>> path = metric_through(decay, Equation(rate=3.0), jnp.array([0.5]), length=20.0, steps=100)
        >>> round(float(path.metric[-1, 0, 0]), 6)
        1.0
    """
    check_state(model, x)
    n, dtype = x.shape[0], x.dtype
    input_held, t0 = model_input(model, u, dtype), jnp.zeros((), dtype)
    h = jnp.asarray(length, dtype) / steps
    eye = jnp.eye(n, dtype=dtype)

    def back(y, _):
        return rk8(lambda s, y: -model.f(t0, y, input_held), t0, y, h), y

    # Each step records the state before it, so `later` begins with x, the last node of the way forward.
    first, later = jax.lax.scan(back, x, length=steps)
    nodes = jnp.concatenate([first[None], later[::-1]])

    def riccati(s, joint):
        y, p = joint
        a, q, c = coefficients(model, equation, y, input_held)
        quadratic = 0.0 if q is None else p @ q @ p
        # L_f P = Ṗ + P f_x + f_xᵀ P solved for Ṗ; a = f_x + λ/2 contains the rate, the scaled rows c contain R⁻¹.
        return model.f(t0, y, input_held), -p @ a - a.T @ p + c.T @ c - quadratic

    def radon(s, joint):
        y, alpha, beta = joint
        a, q, c = coefficients(model, equation, y, input_held)
        # P = αβ⁻¹ has Ṗ = α'β⁻¹ − P β'β⁻¹, the Riccati equation. The first line of (10) is misprinted, see the errata.
        grown = a @ beta if q is None else q @ alpha + a @ beta
        return model.f(t0, y, input_held), -a.T @ alpha + c.T @ c @ beta, grown

    def forward(p, node):
        # Each step starts from the state stored on the way back, so an unstable solution is followed exactly.
        if route == "riccati":
            p = rk8(riccati, t0, (node, p), h)[1]
        else:
            # The pair restarts from (P, I) at each step: over a long time both grow along the same solutions, and β
            # becomes singular.
            _, alpha, beta = rk8(radon, t0, (node, p, eye), h)
            p = alpha @ jnp.linalg.inv(beta)
        # Rounding makes P slightly asymmetric; the exact solution is symmetric.
        p = (p + p.T) / 2
        return p, p

    start = start * eye if jnp.ndim(start) == 0 else jnp.asarray(start)
    metrics = jax.lax.scan(forward, start, nodes[:-1])[1]
    t = h * jnp.arange(-steps, 1, dtype=dtype)
    return Characteristic(t, nodes, jnp.concatenate([start[None], metrics]))
