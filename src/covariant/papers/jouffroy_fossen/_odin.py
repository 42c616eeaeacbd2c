"""Reproduces ODIN under output feedback, section IV of Jouffroy & Fossen 2004: controller, observer, loop and proof."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.certificates import Corners, at_corners, contraction, crossed_metric, falsify, virtual
from covariant.models import marine, state_space
from covariant.observers import Contracting, craft_observer
from covariant.simulation import Backstepping, lissajous, observe
from scalargraph import jacobian
from scalargraph.proofs import Box

KP, KD, LAMBDA = 100.0, 200.0, 0.5
"""Gains K_p, K_d and Λ of the controller of ODIN."""
PRINTED_K2 = (1.0 - KP) * np.eye(6)
"""K2 = I − K_p, as printed below (103)."""
K1, K2 = np.diag([1.7] * 3 + [3.0] * 3), np.diag([240.0] * 3 + [150.0] * 3)
"""Repaired gains of the observer (101)–(102): K2 symmetric positive definite."""
CROSS = np.diag([140.0] * 3 + [6.5] * 3)
"""Cross term N of the observer's metric, see `crossed_metric`."""
RATE = 0.8
"""Certified rate of squared lengths of ODIN's observer [1/s]."""


def odin_path():
    """Motion in all six degrees of freedom: a slow Lissajous figure, rolling and pitching by 0.3 and 0.4 rad.

    Returns:
        The reference `t -> Reference`.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.papers.jouffroy_fossen import odin_path
        >>> odin_path()(jnp.zeros(())).position[:3].round(2).tolist()
        [0.0, 1.44, 5.84]
    """
    return lissajous(
        centre=(0.0, 0.0, 5.0, 0.0, 0.0, 0.0),
        amplitude=(4.0, 3.0, 1.0, 0.3, 0.4, 1.0),
        frequency=(0.1, 0.2, 0.15, 0.12, 0.17, 0.08),
        phase=(0.0, 0.5, 1.0, 0.3, 0.0, 0.7),
    )


def odin_controller() -> Backstepping:
    """The paper's controller (94), with K_p = 100, K_d = 200, Λ = 0.5."""
    return Backstepping(marine.odin(), odin_path(), KP, KD, LAMBDA)


def odin_observer(k2: Float[np.ndarray, "6 6"] = K2) -> Contracting:
    """The paper's observer (101)–(102).

    Args:
        k2: Gain K2 (6, 6), by default the repaired one.

    Returns:
        The observer, with K1 = `K1`.
    """
    return craft_observer(marine.odin(), K1, k2)


class Loop(NamedTuple):
    """Errors of a closed loop.

    Attributes:
        t: Stamps (T,) [s].
        tracking: Norms (T,) of the tracking error (η̃, s).
        observer: Norms (T,) of the observer's error.

    Example:
        >>> import numpy as np
        >>> from covariant.papers.jouffroy_fossen import Loop, tail_rate
        >>> t = np.linspace(0.0, 10.0, 101)
        >>> loop = Loop(t, tracking=np.exp(-t / 2), observer=np.exp(-t))
        >>> round(tail_rate(loop.t, loop.tracking), 6), round(tail_rate(loop.t, loop.observer), 6)
        (0.5, 1.0)
    """

    t: np.ndarray
    tracking: np.ndarray
    observer: np.ndarray


@eqx.filter_jit
def _closed_loop(controller: Backstepping, observer: Contracting, x0: Array, estimate: Array, t: Array):
    n = len(controller.craft.coordinates)
    start = observer.init(x0[:n])._replace(x=estimate)
    plant = state_space(controller.craft)
    x, state = observe(plant, observer, x0, start, t, controller=controller, rtol=1e-9, atol=1e-12, max_steps=100_000)
    e = jax.vmap(controller.error)(t, x[:, :n])
    s = x[:, n:] - jax.vmap(controller.virtual_velocity)(t, x[:, :n])
    return x, jnp.concatenate([e, s], axis=1), x - state.x


def closed_loop(controller: Backstepping, observer: Contracting, x0: np.ndarray, estimate: np.ndarray, t: np.ndarray):
    """Simulate the closed loop (94), (101)–(102) of a craft.

    Args:
        controller: The controller, with its craft.
        observer: The observer of this craft.
        x0: First state (η, ν) (n + m,).
        estimate: First estimate of it.
        t: Stamps (T,) [s].

    Returns:
        States (T, n + m), and the norms (T,) of the tracking error (η̃, s) and of the observer's error.
    """
    x, e, error = _closed_loop(controller, observer, *map(jnp.asarray, (x0, estimate, t)))
    return np.asarray(x), *(np.linalg.norm(np.asarray(a), axis=1) for a in (e, error))


def odin_loop(k2: Float[np.ndarray, "6 6"] = K2, duration: float = 60.0) -> Loop:
    """Simulate the closed loop (94), (101)–(102), from initial errors of a metre and some degrees.

    The plant is the true one, including J'.

    Args:
        k2: Gain K2 (6, 6) of the observer, by default the repaired one.
        duration: Length of the simulation [s].

    Returns:
        Errors at 10 Hz.
    """
    t = np.linspace(0.0, duration, round(10 * duration) + 1)
    first = np.array([1.0, -1.0, 4.0, 0.1, -0.1, 0.3, *[0.0] * 6])
    off = np.array([0.3, -0.2, 0.2, 0.05, 0.05, -0.1, 0.2, 0.1, -0.1, 0.05, -0.05, 0.1])
    return Loop(t, *closed_loop(*_parts(tuple(map(tuple, k2.tolist()))), first, first + off, t)[1:])


@functools.cache  # the same object for equal arguments, so that compiled programs are reused
def _parts(k2: tuple[tuple[float, ...], ...]) -> tuple[Backstepping, Contracting]:
    return odin_controller(), odin_observer(np.array(k2))


def odin_box(pitch: float = 0.7, roll: float = 0.7, rate: float = 0.2, speed: float = 0.5, spin: float = 0.3) -> Box:
    """Box of the observer's virtual system.

    Position and yaw have no effect and are fixed at zero; so are the input and the estimated position.

    Args:
        pitch: Bound of the pitch [rad].
        roll: Bound of the roll [rad].
        rate: Bound of the rates of the attitude [rad/s].
        speed: Bound of the estimated linear velocities [m/s].
        spin: Bound of the estimated angular velocities [rad/s].

    Returns:
        The box, symmetric about zero.
    """
    error_system = virtual(odin_observer(), np.eye(12))
    wide = {"z_roll": roll, "z_pitch": pitch, "zdot_roll": rate, "zdot_pitch": rate, "zdot_yaw": rate}
    wide |= dict.fromkeys(("surge", "sway", "heave"), speed) | dict.fromkeys(
        ("roll_rate", "pitch_rate", "yaw_rate"), spin
    )
    high = np.array([wide.get(name, 0.0) for name in error_system.names])
    return Box(error_system.names, error_system.units, -high, high)


def odin_certificate(rate: float, domain: Box | None = None, boxes: int = 200_000) -> Corners:
    """Prove that the repaired observer contracts, in the metric with the cross term.

    Translation and rotation are independent blocks, which are proved separately. Velocities enter only through the
    slope 2|ν| of the drag. So it suffices to consider velocities ≥ 0, for which the drag is a square with a linear
    slope.

    Args:
        rate: Rate of squared lengths [1/s].
        domain: The set, by default `odin_box()`.
        boxes: Largest number of boxes into which the set is divided.

    Returns:
        The proof at the corners.
    """
    domain = odin_box() if domain is None else domain
    names = marine.odin().velocities
    low = np.where(np.isin(domain.names, names), 0.0, domain.low)
    square = np.diag(marine.odin().damping(jnp.ones(6)))
    ahead = eqx.tree_at(lambda c: c.damping, marine.odin(), lambda nu: jnp.diag(jnp.asarray(square) * nu))
    error_system = virtual(craft_observer(ahead, K1, K2), crossed_metric(ahead, K2, CROSS))
    matrix = contraction(error_system, rate)
    return at_corners(
        matrix,
        domain._replace(low=low),
        (*names, "zdot_roll", "zdot_pitch", "zdot_yaw"),
        f"squared lengths of the repaired observer of ODIN shrink at {rate:g} 1/s or faster",
        boxes=boxes,
    )


def odin_sampled_rate(k2: np.ndarray = K2, cross: np.ndarray = CROSS, domain: Box | None = None) -> float:
    """Least rate [1/s] over samples of the set; for K2 = I without a cross term it is at most 0 for any drag.

    Args:
        k2: Gain K2 (6, 6) of the observer, by default the repaired one.
        cross: Cross term N (6, 6) of the metric.
        domain: The set, by default `odin_box()`.

    Returns:
        The rate of squared lengths.
    """
    error_system = virtual(odin_observer(k2), crossed_metric(marine.odin(), k2, cross))
    return falsify(error_system, domain or odin_box(), 0.0).margin


@eqx.filter_jit
def _slope_at_rest(observer: Contracting) -> Array:
    return jacobian(lambda x: observer.virtual(jnp.zeros(()), x, jnp.zeros(6), jnp.zeros(6)), jnp.zeros(12))


def odin_eigenvalues() -> dict[str, float]:
    """Largest real part [1/s] of the linearised observer error, at rest and level.

    Returns:
        Real parts for K2 as `printed`, `identity`, and as `repaired`.
    """
    real_parts = {}
    for name, k2 in (("printed", PRINTED_K2), ("identity", np.eye(6)), ("repaired", K2)):
        observer = odin_observer(k2)
        real_parts[name] = float(np.linalg.eigvals(np.asarray(_slope_at_rest(observer))).real.max())
    return real_parts


def tail_rate(t: np.ndarray, error: np.ndarray, floor: float = 1e-7) -> float:
    """Slope of −log error over time, over the second half of the time until the error reaches a floor.

    Args:
        t: Stamps (T,) [s].
        error: Positive norms (T,).
        floor: Error below which the accuracy of the integration hides the decay.

    Returns:
        The rate [1/s].
    """
    # `argmax` is 0 if the error never reaches the floor.
    end = int(np.argmax(error < floor)) or len(t)
    later = slice(end // 2, end)
    return -float(np.polyfit(t[later], np.log(error[later]), 1)[0])
