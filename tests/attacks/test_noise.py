"""What measurement noise and unmodelled forces do, simulated, against what is claimed about it.

An error b of the measured position enters an observer three times: by its gains, as αb and βb, and because the force
is taken where the system was measured to be, as S(q + b) − S(q).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import line, verdict


def errors(alpha, beta, force, noise, seconds: float, steps: int, friction=0.0, start=0.3, unmodelled=None):
    """Largest errors (2, k) of position and velocity in the last tenth, under noises `(steps, k)` on the position.

    A unit mass with q'' = S(q) − friction q' + unmodelled. All integrated by the rule of Runge and Kutta.
    """
    h = seconds / steps
    extra = np.zeros_like(noise) if unmodelled is None else unmodelled
    state = np.stack([np.full(noise.shape[1], start), np.zeros(noise.shape[1])] * 2)

    def change(state, b, a):
        q, v, estimated, speed = state
        measured = q + b
        off = estimated - measured
        pull = force(measured)
        return np.stack(
            [
                v,
                force(q) - friction * v + a,
                speed - alpha * off,
                pull - friction * speed - beta * off,
            ]
        )

    worst = np.zeros((2, noise.shape[1]))
    for k in range(steps):
        b, a = noise[k], extra[k]
        k1 = change(state, b, a)
        k2 = change(state + h / 2 * k1, b, a)
        k3 = change(state + h / 2 * k2, b, a)
        k4 = change(state + h * k3, b, a)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if k > 0.9 * steps:
            worst = np.maximum(worst, np.abs(state[2:] - state[:2]))
    return worst


def worst_linear(alpha, beta, stiffness, noise, friction=0.0, unknown=0.0) -> np.ndarray:
    """The largest errors that any noise and unknown force of these sizes bring to a spring.

    These are the integrals of |impulse response|; an unknown force w brings ζ' = −βξ − friction · ζ − w.
    """
    a = np.array([[-alpha, 1.0], [-beta, -friction]])
    values, vectors = np.linalg.eig(a)
    t, total = np.linspace(0, 25 / np.abs(values.real).min(), 4001), np.zeros(2)
    for push, size in (([alpha, beta - stiffness], noise), ([0.0, 1.0], unknown)):
        parts = np.linalg.solve(vectors, np.array(push, complex))
        response = np.abs((vectors @ (np.exp(np.outer(values, t)) * parts[:, None])).real)
        total += size * np.trapezoid(response, t, axis=1)
    return total


def sprung(stiffness: float, force=None):
    """A point mass on a spring."""
    return line(lambda xp, x, v: -0.5 * v, force=force, potential=lambda q: stiffness * q[0] ** 2 / 2)


USUAL = {"velocity": 3.0, "error": 0.5, "position": (-1.0, 1.0), "input": 0.1}


def test_noise_on_a_stiff_spring_is_more_than_its_tube_bears():
    """A millimetre on 4000 1/s² leaves 80 mm; a tube of a centimetre does not hold that."""
    assert verdict(sprung(4000.0), **(USUAL | {"error": 0.01}), noise=1e-3) != "holds"


REFUSED = {
    "a force that jumps": ({"noise": 1e-3}, lambda t, q, u: u + jnp.where(q > 0, 1.0, -1.0)),
    "a force with a steep ramp": ({"noise": 1e-3}, lambda t, q, u: u + 10 * jnp.clip(1e7 * q, -1.0, 1.0)),
    "a force without a slope": ({"noise": 1e-3}, lambda t, q, u: u + 0 * jnp.sqrt(q)),
    "a force hidden from derivatives": ({"noise": 1e-3}, lambda t, q, u: u + 5e3 * jax.lax.stop_gradient(q)),
    "noise as large as the error": ({"noise": 0.5}, None),
    "noise beyond the error": ({"noise": 0.6}, None),
    "noise below nought": ({"noise": -1e-3}, None),
    "noise that is no number": ({"noise": np.nan}, None),
    "noise without bound": ({"noise": np.inf}, None),
    "unknown force below nought": ({"disturbance": -1.0}, None),
    "unknown force that is no number": ({"disturbance": np.nan}, None),
    "unknown force without bound": ({"disturbance": np.inf}, None),
    "unknown force that is too large": ({"disturbance": 1e3}, None),
}


@pytest.mark.core(5)
@pytest.mark.parametrize("name", REFUSED)
def test_noise_that_no_bound_covers_is_never_proved(name):
    acting, force = REFUSED[name]
    assert verdict(sprung(1.0, force), **USUAL, **acting) != "holds"
