"""Defines the box of a certificate: the order of its variables, and the data from which force bounds are computed."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

STEPS = ("step", "inner_step")
"""Names of the further variables of the claim "prediction": two lengths of a step."""


class Given(NamedTuple):
    """Bounds from which the bounds of the force and of the measurements follow.

    Attributes:
        positions: least and largest positions (2, p), on a group the entries of its matrices.
        inputs: least and largest inputs (2, m).
        times: first and last time (2,) [s].
        noise: bounds (n,) of the error of each measured position.
        disturbance: bounds (n,) of each component of a force that the model lacks.
        slopes: bounds (n, n) of the derivatives of the force by the position; 0 without noise.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates.base import Given
        >>> positions, inputs, times = np.array([[-1.0], [1.0]]), np.zeros((2, 0)), np.zeros(2)
        >>> bounds = Given(positions, inputs, times, *np.zeros((2, 1)), np.zeros((1, 1)))
        >>> bounds.document()["positions"]
        {'low': [-1.0], 'high': [1.0]}
    """

    positions: Float[np.ndarray, "2 p"]
    inputs: Float[np.ndarray, "2 m"]
    times: Float[np.ndarray, "2"]
    noise: Float[np.ndarray, "n"]
    disturbance: Float[np.ndarray, "n"]
    slopes: Float[np.ndarray, "n n"]

    def document(self) -> dict[str, Any]:
        """Convert the bounds to data for the file.

        Returns:
            Lists of numbers by name; for positions and inputs the "low" and the "high" ends.
        """
        plain = {key: value.tolist() for key, value in self._asdict().items()}
        return plain | {key: dict(zip(("low", "high"), plain[key], strict=True)) for key in ("positions", "inputs")}


def first_velocity(variables: int, n: int, sampled: bool = False) -> int:
    """Return the place of the first velocity in the box, after the variables of the configuration."""
    # Without samples the coordinates are variables, except on a group; velocities, errors and forces take 3n places.
    # Signals that the friction reads come last, and are not counted here.
    return variables - (5 * n + 1) if sampled else n * (variables > 3 * n)


def prediction_variables(names: Sequence[str], units: Sequence[str], n: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names and units of the variables of the claim "prediction"."""
    places = prediction_places(len(names), n)
    return (*(names[k] for k in places), *STEPS), (*(units[k] for k in places), "s", "s")


def prediction_places(variables: int, n: int) -> list[int]:
    """Return the places in the box of configuration, velocity, force of the input and age."""
    count = first_velocity(variables, n, sampled=True)
    return [*range(count + n), *range(count + 2 * n, count + 3 * n), variables - 1]
