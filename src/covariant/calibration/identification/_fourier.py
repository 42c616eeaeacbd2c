"""Periodic motions of joints as finite Fourier series, which may start and end each period at rest.

Source: Swevers, Ganseman, Tükel, De Schutter & Van Brussel 1997, Optimal Robot Excitation and Identification, IEEE
Transactions on Robotics and Automation 13(5), equations (14) to (16).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class FourierMotion(NamedTuple):
    """Motion of n joints as sums of H harmonics: `q = centre + Σ sₖ sin(k ω t) + cₖ cos(k ω t)`.

    Attributes:
        frequency: Frequency ω/2π [Hz] of the first harmonic.
        centre: Means (n,) of the positions.
        coefficients: Coefficients (2 H, n) of the H sines, then of the H cosines.

    Example:
        >>> import numpy as np
        >>> from covariant.calibration.identification import FourierMotion
        >>> swing = FourierMotion(0.5, np.array([1.0]), np.array([[0.2], [0.0]]))
        >>> q, v, a = swing.at(np.array([0.0, 0.5]))
        >>> q.round(3).tolist(), v.round(3).tolist()
        ([[1.0], [1.2]], [[0.628], [0.0]])
    """

    frequency: float
    centre: Float[np.ndarray, "n"]
    coefficients: Float[np.ndarray, "h n"]

    @property
    def harmonics(self) -> int:
        """Number H of harmonics."""
        return len(self.coefficients) // 2

    def at(
        self, t: Float[np.ndarray, "T"]
    ) -> tuple[Float[np.ndarray, "T n"], Float[np.ndarray, "T n"], Float[np.ndarray, "T n"]]:
        """Positions, velocities and accelerations (T, n) at the times t (T,) [s]."""
        q, v, a = fourier_basis(t, self.frequency, self.harmonics) @ self.coefficients
        return q + self.centre, v, a

    def scaled(self, factor: float) -> "FourierMotion":
        """The motion with all amplitudes multiplied by a factor."""
        return self._replace(coefficients=factor * self.coefficients)


def fourier_basis(t: Float[np.ndarray, "T"], frequency: float, harmonics: int) -> Float[np.ndarray, "3 T h"]:
    """Sines and cosines of the harmonics at the times t, and their first and second derivatives."""
    pace = 2 * np.pi * frequency * np.arange(1, harmonics + 1)
    sine, cosine = np.sin(pace * t[:, None]), np.cos(pace * t[:, None])
    rows = [sine, cosine], [pace * cosine, -pace * sine], [-(pace**2) * sine, -(pace**2) * cosine]
    return np.stack([np.concatenate(parts, axis=1) for parts in rows])


def resting_basis(harmonics: int) -> Float[np.ndarray, "h m"]:
    """Orthonormal basis of the coefficients (2 H,) whose motions begin each period with zero velocity and acceleration.

    At t = 0 the velocity is `Σ k ω sₖ` and the acceleration `−Σ k² ω² cₖ`.
    """
    from scipy.linalg import block_diag, null_space

    order = np.arange(1, harmonics + 1, dtype=float)
    return np.asarray(block_diag(null_space(order[None, :]), null_space(order[None, :] ** 2)))


def one_sine_a_joint(
    frequency: float,
    harmonics: int,
    centre: Float[np.ndarray, "n"],
    room: Float[np.ndarray, "n"],
    velocity: Float[np.ndarray, "n"],
) -> FourierMotion:
    """Motion by one sine a joint, the harmonics spread over the joints from the first to the last.

    Each is as large as positions and velocities of its joint allow.
    """
    coefficients = np.zeros((2 * harmonics, len(centre)))
    order = np.rint(np.linspace(1, harmonics, len(centre))).astype(int)
    coefficients[order - 1, np.arange(len(centre))] = np.minimum(room, velocity / (2 * np.pi * frequency * order))
    return FourierMotion(frequency, centre, coefficients)
