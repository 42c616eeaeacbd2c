"""Defines the passive observer of ships: low-frequency and wave motion, and slow forces, from the position alone.

Source: Fossen & Strand 1999, Passive nonlinear observer design for ships using Lyapunov methods, Automatica 35(1);
Jouffroy & Fossen 2004, equations (43)–(60) with the signs of (54) and (59) corrected.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._linalg import solve, whiten
from covariant._typing import Matrix, Number, Numbers, Scalar, Vector
from covariant.models.marine import Station, positive_definite, yaw_rotation
from covariant.observers.base import AbstractFlowObserver, Info, as_gain
from covariant.observers.constant_gain._contracting import Contracting, ContractingState
from scalargraph.errors import InputError


class PassiveGains(NamedTuple):
    """Gains of `PassiveShip`.

    The gain of the velocity is `K2(ψ) = P2⁻¹ Rᵀ(ψ) P1 + A1(ψ)`, (49) and (60); if P2 is the ship's own mass, it is
    `M⁻¹ Rᵀ P1 + A1`.

    Attributes:
        position: K1 (3, 3) [1/s].
        stiffness: P1 (3, 3), symmetric positive definite.
        inertia: P2 (3, 3), symmetric positive definite.
        bias: K3 (3, 3) [N/(m s), and N m in place of N for the heading].
        waves: Gain (6, 3) of the notch filter: the upper half [1] for the integral of the wave motion, the lower one
            [1/s] for the motion.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> station = models.marine.Station(models.marine.supply_vessel())
        >>> observers.lyapunov_gains(station, stiffness=np.eye(3), q1=0.1 * np.eye(3))._fields
        ('position', 'stiffness', 'inertia', 'bias', 'waves')
    """

    position: Matrix
    stiffness: Matrix
    inertia: Matrix
    bias: Matrix
    waves: Float[Array, "6 3"]


class PassiveShip(AbstractFlowObserver):
    """Observer (43)–(44) of a `marine.Station`, including waves, bias and thrusters if the station has them.

    It is the observer `Contracting` with the station's model: rotations use the measured heading, or the estimated one
    while the heading is missing. The first row of a record must contain north, east and heading: the estimate starts
    from them, at rest.

    Attributes:
        station: The ship with its disturbances.
        gains: Gains, from `lyapunov_gains` for a ship alone, or from `notch_gains` for a ship at sea.
        substeps: Number of Runge–Kutta steps of the model in each sample, 1 by default.
        memory: Upper bound [s] of the weight of an output, infinite by default; see `Contracting`.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> station = models.marine.Station(models.marine.supply_vessel())
        >>> gains = observers.lyapunov_gains(station, stiffness=np.eye(3), q1=0.1 * np.eye(3))
        >>> observer = observers.PassiveShip(station, gains)
        >>> observer.estimate(observer.init(jnp.array([3.0, -2.0, 0.5]))).tolist()
        [3.0, -2.0, 0.5, 0.0, 0.0, 0.0]
    """

    station: Station
    gains: PassiveGains
    substeps: int = eqx.field(default=1, static=True)
    memory: Scalar = eqx.field(default=jnp.inf, converter=as_gain)

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> ContractingState:
        """State at rest at the measured position.

        Args:
            y: North [m], east [m] and heading [rad] (3,).
            t: Time stamp [s], 0 by default.

        Returns:
            The state, with zero waves, bias and thrust if the station has them.

        Raises:
            ValueError: y has another shape, or an entry of it is missing; a traced y has no values to check.
        """
        if y.shape != (3,):
            raise InputError(f"a ship's measurement is north, east and heading; this one has shape {y.shape}")
        if not isinstance(y, Tracer) and np.isnan(y).any():
            raise InputError("the first row must hold north, east and heading; one is missing: start at a row with all")
        start = jnp.zeros(self.station.order, y.dtype).at[:3].set(y)
        return ContractingState(start, jnp.asarray(t, y.dtype), jnp.zeros_like(y), jnp.zeros_like(y))

    def estimate(self, state: ContractingState) -> Vector:
        return state.x

    def flow(self, t: Scalar, state: ContractingState, u: Float[Array, "3"], y: Float[Array, "3"]) -> ContractingState:
        return self.contracting().flow(t, state, u, y)

    def predict(self, state: ContractingState, u: Float[Array, "3"], dt: Scalar) -> ContractingState:
        return self.contracting().predict(state, u, dt)

    def correct(
        self, state: ContractingState, u: Float[Array, "3"], y: Float[Array, "3"]
    ) -> tuple[ContractingState, Info]:
        return self.contracting().correct(state, u, y)

    def contracting(self) -> Contracting:
        """The same observer as a `Contracting`, which has a virtual system.

        Returns:
            The observer, whose virtual system is that of (43)–(44).
        """
        return Contracting(
            self.station.model(),
            lambda t, z: self.gain(z[2]),
            jnp.zeros(self.station.order),
            lambda t, x, u, z: self.station.derivative(z[2], x, u),
            self.substeps,
            self.memory,
        )

    def gain(self, heading: Scalar) -> Float[Array, "n 3"]:
        """Gain K(ψ), with one row for each state.

        Args:
            heading: Heading ψ [rad], measured.

        Returns:
            Matrix (n, 3), with rows in the order of `Station.parts`.
        """
        g = PassiveGains(*(jnp.asarray(a, heading.dtype) for a in self.gains))
        turn = yaw_rotation(heading)
        rows = {
            "eta": g.position,
            "nu": solve(g.inertia, turn.T @ g.stiffness) + position_matrix(self.station, heading),
            "waves": g.waves,
            "bias": g.bias,
            "thrust": jnp.zeros((3, 3), heading.dtype),
        }
        return jnp.concatenate([rows[part] for part in self.station.parts])


def position_matrix(station: Station, heading: Scalar) -> Matrix:
    """Matrix `A1(ψ) = −M⁻¹ Rᵀ(ψ) K`: the ship's acceleration per position, (40)–(41)."""
    return _station_matrix(station, heading, "eta")


def velocity_matrix(station: Station) -> Matrix:
    """Matrix `A2 = −M⁻¹ D`: the ship's acceleration per velocity, at rest, (40)–(41)."""
    return _station_matrix(station, jnp.zeros(()), "nu")


def _station_matrix(station: Station, heading: Scalar, part: str) -> Matrix:
    """Derivative (3, 3) of the ship's acceleration in one part of the state (3,), at rest at the origin."""
    rest, zero, parts = jnp.zeros(station.order, heading.dtype), jnp.zeros(3, heading.dtype), station.parts

    def acceleration(values):
        return station.derivative(heading, rest.at[parts[part]].set(values), zero)[parts["nu"]]

    return jax.jacfwd(acceleration)(zero)


def lyapunov_gains(station: Station, stiffness: Numbers, q1: Numbers, q2: Numbers | None = None) -> PassiveGains:
    """Gains of the ship alone from `V = ½(η̃ᵀP1η̃ + ν̃ᵀP2ν̃)`, `V' = −η̃ᵀQ1η̃ − ν̃ᵀQ2ν̃`: (48)–(50).

    `K1 = P1⁻¹Q1`, and P2 solves `½(P2A2 + A2ᵀP2) = −Q2`.

    Use it for a `PassiveShip` whose station has no waves and no slowly varying force; their gains are zero. A larger
    P1⁻¹Q1 corrects the position faster and passes more of its noise.

    Args:
        station: The ship with its disturbances.
        stiffness: P1 (3, 3), symmetric positive definite.
        q1: Q1 (3, 3), symmetric positive definite.
        q2: Q2 (3, 3), symmetric positive definite. By default P2 is the ship's mass, so that Q2 is the symmetric part
            of its damping.

    Returns:
        Gains with zero `bias` and `waves`.

    Raises:
        ValueError: A matrix is not symmetric positive definite, A2 is not Hurwitz, or, without q2, the damping does not
            dissipate energy in every motion.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> station = models.marine.Station(models.marine.supply_vessel())
        >>> gains = observers.lyapunov_gains(station, stiffness=np.eye(3), q1=0.1 * np.eye(3))
        >>> bool(np.allclose(gains.position, 0.1 * np.eye(3))), bool(np.allclose(gains.inertia, station.ship.mass))
        (True, True)
    """
    p1, q1_matrix = (np.asarray(positive_definite(name, a, 3)) for name, a in (("stiffness", stiffness), ("q1", q1)))
    a2 = np.asarray(velocity_matrix(station))
    largest = np.linalg.eigvals(a2).real.max()
    if not largest < 0:
        raise InputError(
            f"A2 = −M⁻¹D is not Hurwitz: an eigenvalue has real part {largest:.3g}; the ship needs damping"
        )
    if q2 is None:
        p2 = np.asarray(station.ship.mass)
        positive_definite("the symmetric part of the damping", -(p2 @ a2 + a2.T @ p2) / 2, 3)
    else:
        q2_matrix = np.asarray(positive_definite("q2", q2, 3))
        identity = np.eye(3)
        # The Lyapunov equation as a linear system, row by row: vec(P2A2 + A2ᵀP2) = (I⊗A2ᵀ + A2ᵀ⊗I) vec P2.
        p2 = np.linalg.solve(np.kron(identity, a2.T) + np.kron(a2.T, identity), -2 * q2_matrix.ravel()).reshape(3, 3)
        p2 = (p2 + p2.T) / 2  # removes rounding from the symmetric matrix
    no_bias = np.zeros((3, 3))
    return _gains(np.linalg.solve(p1, q1_matrix), p1, p2, no_bias, np.zeros((6, 3)))


def lyapunov_rate(station: Station, gains: PassiveGains) -> float:
    """Largest α [1/s] with `Q ≥ αP`, so that `V ≤ e^(−2αt) V(0)` for the ship alone.

    (47) uses `λmin(Q) / λmax(P)`, which is never larger and depends on the units; see `printed_rate`.

    Args:
        station: The ship with its disturbances.
        gains: Gains, from `lyapunov_gains`.

    Returns:
        The rate α [1/s].

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> station = models.marine.Station(models.marine.supply_vessel())
        >>> gains = observers.lyapunov_gains(station, stiffness=np.eye(3), q1=0.1 * np.eye(3))
        >>> observers.lyapunov_rate(station, gains) > observers.printed_rate(station, gains) > 0
        True
    """
    forms = _forms(station, gains)
    # The smallest eigenvalue of the pencil (Q, P), block by block.
    return float(min(np.linalg.eigvalsh(whiten(jnp.asarray(p), jnp.asarray(q)))[0] for p, q in forms))


def printed_rate(station: Station, gains: PassiveGains) -> float:
    """Rate `α = λmin(Q) / λmax(P)` as printed in (47), in the units of the model.

    Args:
        station: The ship with its disturbances.
        gains: Gains, from `lyapunov_gains`.

    Returns:
        The rate α [1/s].

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> ship = models.marine.surface_ship(2.0 * np.eye(3), 0.4 * np.eye(3))
        >>> station = models.marine.Station(ship)
        >>> gains = observers.lyapunov_gains(station, stiffness=np.eye(3), q1=0.5 * np.eye(3))
        >>> round(observers.printed_rate(station, gains), 6)  # λmin(Q) = 0.4, λmax(P) = 2
        0.2
    """
    forms = _forms(station, gains)
    return float(min(np.linalg.eigvalsh(q)[0] for _, q in forms) / max(np.linalg.eigvalsh(p)[-1] for p, _ in forms))


def _forms(station: Station, gains: PassiveGains) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The pairs (P1, Q1) and (P2, Q2) of the Lyapunov function and its derivative."""
    a2 = np.asarray(velocity_matrix(station))
    p1, p2, k1 = (np.asarray(a) for a in (gains.stiffness, gains.inertia, gains.position))
    return (p1, (p1 @ k1 + k1.T @ p1) / 2), (p2, -(p2 @ a2 + a2.T @ p2) / 2)


def notch_gains(
    station: Station,
    bandwidth: Sequence[float],
    cutoff: Sequence[float] | None = None,
    notch_damping: float = 1.0,
) -> PassiveGains:
    """Diagonal gains for a ship at sea: a loop for position, velocity and bias behind a notch at the wave frequency.

    The stiffness is `M K1 ω/2`, and the bias follows at a tenth of the bandwidth.

    Args:
        station: The ship with its disturbances.
        bandwidth: Bandwidth ω (3,) [rad/s] of the velocity in north, east and heading, below the waves.
        cutoff: Cutoff (3,) [rad/s] of the wave filter, above the waves; by default 1.22 times their frequency.
        notch_damping: Relative damping of the notch, above that of the waves; 1 by default.

    Returns:
        The gains, with zero `waves` or `bias` if the station has none.

    Raises:
        ValueError: An entry of `bandwidth` or `cutoff` is not positive, or `notch_damping` does not exceed the damping
            of the waves.

    Source: Fossen & Strand 1999, equations (41)–(46).

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> waves = models.marine.Waves((0.8,) * 3, (0.1,) * 3, (0.5, 0.5, 0.01))
        >>> station = models.marine.Station(models.marine.supply_vessel(), waves)
        >>> gains = observers.notch_gains(station, bandwidth=(0.1, 0.1, 0.2))
        >>> np.diag(gains.position).round(3).tolist()  # 1.22 · 0.8
        [0.976, 0.976, 0.976]
    """
    bandwidths = _three_positive("bandwidth", bandwidth)
    m = np.diag(np.asarray(station.ship.mass))
    waves, cutoffs = np.zeros((6, 3)), 2 * bandwidths
    if station.waves is not None:
        w, z = np.asarray(station.waves.frequency), np.asarray(station.waves.damping)
        cutoffs = 1.22 * w if cutoff is None else _three_positive("cutoff", cutoff)
        if not (notch_damping > z).all():
            raise InputError(f"notch_damping must exceed that of the waves, {z.max():g}; got {notch_damping:g}")
        # From the measurement to the wave-free error there remains a notch with this damping at ω, (41)–(46).
        waves = np.concatenate([np.diag(-2 * (notch_damping - z) * cutoffs / w), np.diag(2 * w * (notch_damping - z))])
    # Without waves s² + K1 s + P1/m is (s + ω)²: the cutoff is 2ω, and P1/m is ω².
    stiffness = m * cutoffs * bandwidths / 2
    # With K3/m = ωcω²/20 Routh's condition for s³ + ωc s² + ½ωcω s + K3/m is ω < 10 ωc.
    bias = stiffness * bandwidths / 10 if station.bias_time is not None else np.zeros(3)
    return _gains(np.diag(cutoffs), np.diag(stiffness), np.asarray(station.ship.mass), np.diag(bias), waves)


def _three_positive(name: str, entries: Sequence[float]) -> np.ndarray:
    values = np.asarray(entries, float)
    if values.shape != (3,) or not (values > 0).all():
        raise InputError(f"{name} needs three positive numbers [rad/s], for north, east, heading; got {entries}")
    return values


def _gains(*matrices: np.ndarray) -> PassiveGains:
    return PassiveGains(*(jnp.asarray(a) for a in matrices))
