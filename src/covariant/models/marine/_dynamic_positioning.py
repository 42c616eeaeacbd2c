"""Models a ship in dynamic positioning: first-order wave motion, slowly varying forces, and thrusters with a lag.

Source: Fossen & Strand 1999, Passive nonlinear observer design for ships using Lyapunov methods, Automatica 35(1);
Jouffroy & Fossen 2004, equations (38)–(42), for the ship alone.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Scalar, Vector
from covariant.models._parameters import Parameter
from covariant.models._state_space import StateSpace
from covariant.models.marine._craft import Craft, yaw_rotation
from scalargraph.errors import InputError


class Waves(eqx.Module):
    """First-order wave motion of north, east and heading.

    `ξ₁' = ξ₂`, `ξ₂' = −ω²ξ₁ − 2ζωξ₂ + w`; ξ₂ is part of the measured position.

    Give it to a `Station`, whose observer then separates this motion from the ship's, so that thrusters do not
    counteract waves. Take the frequency from the peak of the wave spectrum. A smaller damping gives a narrower
    spectrum.

    Attributes:
        frequency: Frequencies ω (3,) [rad/s].
        damping: Damping ratios ζ (3,).
        intensity: Root of the spectral density of the white noise w (3,), so that the standard deviation of the motion
            is `intensity / (2 √(ζω))` [m, m, rad].

    Raises:
        ValueError: An entry is not positive.

    Example:
        >>> from covariant import models
        >>> waves = models.marine.Waves((1.0, 1.0, 1.0), (0.25, 0.25, 0.25), std=(1.0, 1.0, 0.5))
        >>> waves.intensity
        (1.0, 1.0, 0.5)
    """

    frequency: tuple[float, ...] = eqx.field(static=True)
    damping: tuple[float, ...] = eqx.field(static=True)
    intensity: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, frequency: Sequence[float], damping: Sequence[float], std: Sequence[float]):
        """Wave motion with a given standard deviation.

        Args:
            frequency: Frequencies ω (3,) [rad/s].
            damping: Damping ratios ζ (3,).
            std: Standard deviation (3,) of the motion in north and east [m] and heading [rad].
        """
        for name, entries in (("frequency", frequency), ("damping", damping), ("std", std)):
            if len(entries) != 3 or not all(0 < entry < np.inf for entry in entries):
                raise InputError(f"waves: {name} needs three positive numbers, for north, east, heading; got {entries}")
        self.frequency, self.damping = tuple(frequency), tuple(damping)
        # The stationary variance of ξ₂ is intensity²/(4ζω).
        self.intensity = tuple(2 * s * (z * w) ** 0.5 for s, z, w in zip(std, damping, frequency, strict=True))


class Station(eqx.Module):
    """A surface ship with the disturbances at sea: waves, a slowly varying force, and thrusters with a lag.

    The states are, in this order: η (3,), ν (3,), ξ (6,), b (3,), τ (3,); each of the last three is present only if the
    station includes it.

    Attributes:
        ship: A `Craft` in the plane, such as `supply_vessel()`.
        waves: Wave motion ξ (6,), added to the measured position; none by default.
        bias_time: Time constant [s] of a slowly varying force b (3,) in north, east and heading [N, N, N m], a Markov
            process; infinity makes it a random walk. None (default) leaves it out.
        thruster_time: Time constant [s] with which the force τ (3,) follows the commanded one. None (default) leaves
            the lag out.

    Raises:
        ValueError: The craft is not planar, or a time is not positive.

    Example:
        >>> from covariant import models
        >>> station = models.marine.Station(models.marine.supply_vessel(), bias_time=1000.0)
        >>> list(station.parts), station.order
        (['eta', 'nu', 'bias'], 9)
    """

    ship: Craft
    waves: Waves | None = None
    bias_time: float | None = eqx.field(default=None, static=True)
    thruster_time: float | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        if self.ship.coordinates != ("north", "east", "heading"):
            raise InputError(f"a station needs a ship in the plane; this craft has {', '.join(self.ship.coordinates)}")
        for name, time in (("bias_time", self.bias_time), ("thruster_time", self.thruster_time)):
            if time is not None and not time > 0:
                raise InputError(f"station: {name} must be positive [s]; got {time}")

    @property
    def parts(self) -> dict[str, slice]:
        """Slices of the parts of the state.

        Returns:
            Slices by name: "eta" and "nu", and "waves", "bias" and "thrust" if the station includes them.
        """
        sizes = {
            "eta": 3,
            "nu": 3,
            "waves": 6 * (self.waves is not None),
            "bias": 3 * (self.bias_time is not None),
            "thrust": 3 * (self.thruster_time is not None),
        }
        ends = np.cumsum(list(sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True) if size}

    @property
    def order(self) -> int:
        """Number of states."""
        return list(self.parts.values())[-1].stop

    def derivative(
        self, heading: Scalar, x: Vector, u: Float[Array, "3"], noise: Float[Array, "k"] | None = None
    ) -> Vector:
        """State derivative x' of the station.

        Args:
            heading: Heading [rad] for the rotations: measured, or taken from the state.
            x: State (n,).
            u: Commanded force (3,) in the body frame [N, N, N m].
            noise: Noise that drives the waves and the bias, three entries each: white noise of unit spectral density
                for the waves, and [N/√s, N/√s, N m/√s] for the bias; zero by default.

        Returns:
            x' (n,).
        """
        part = {name: x[where] for name, where in self.parts.items()}
        turn = yaw_rotation(heading)
        eta, nu = part["eta"], part["nu"]
        force = part.get("thrust", u)
        if "bias" in part:
            force = force + turn.T @ part["bias"]  # b is in north and east; the force is in the body frame
        drive = jnp.zeros(3 * (("waves" in part) + ("bias" in part)), x.dtype) if noise is None else noise
        # The restoring force uses the same heading: if it is measured, both rotations are known functions of time.
        rates = [turn @ nu, self.ship.acceleration(eta.at[2].set(heading), nu, force)]
        if self.waves is not None:
            w, z, k = (
                jnp.asarray(a, x.dtype) for a in (self.waves.frequency, self.waves.damping, self.waves.intensity)
            )
            place, speed = jnp.split(part["waves"], 2)
            rates += [speed, -(w**2) * place - 2 * z * w * speed + k * drive[:3]]
        if self.bias_time is not None:
            # An infinite time constant leaves only the noise: a random walk.
            rates.append(-part["bias"] / self.bias_time + drive[-3:])  # its noise comes last, with or without waves
        if self.thruster_time is not None:
            rates.append((u - part["thrust"]) / self.thruster_time)
        return jnp.concatenate(rates)

    def output(self, x: Vector) -> Float[Array, "3"]:
        """Measured north, east and heading: position plus wave motion.

        Args:
            x: State (n,).

        Returns:
            Output (3,) [m, m, rad].
        """
        eta = x[self.parts["eta"]]
        return eta if self.waves is None else eta + x[self.parts["waves"]][3:]

    def model(self, noise: bool = False) -> StateSpace:
        """State-space model of the station.

        Args:
            noise: Whether the noise of waves and bias is also an input, after the force in u.

        Returns:
            The model, with the outputs north, east and heading.
        """
        extra = 3 * ((self.waves is not None) + (self.bias_time is not None)) if noise else 0

        def f(t, x, u):
            return self.derivative(x[2], x, u[:3], u[3:] if noise else None)

        axes = self.ship.coordinates
        names = {
            "eta": (axes, self.ship.units),
            "nu": (self.ship.velocities, ("m/s", "m/s", "rad/s")),
            "waves": (
                tuple(f"wave_{kind}{a}" for kind in ("integral_", "") for a in axes),
                ("m s", "m s", "rad s", "m", "m", "rad"),
            ),
            "bias": (tuple(f"bias_{a}" for a in axes), ("N", "N", "N m")),
            "thrust": (("thrust_surge", "thrust_sway", "thrust_yaw"), ("N", "N", "N m")),
        }
        return StateSpace(
            f,
            lambda t, x, u: self.output(x),
            coordinates=tuple(name for part in self.parts for name in names[part][0]),
            units=tuple(unit for part in self.parts for unit in names[part][1]),
            outputs=axes,
            inputs=3 + extra,
            circles=(2,),
            parameters=self._parameters(),
        )

    def _parameters(self) -> dict[str, Parameter]:
        chosen = "chosen for this station"
        parameters = dict(self.ship.parameters)
        if self.waves is not None:
            parameters["wave_frequency"] = Parameter(self.waves.frequency, "rad/s", chosen)
            parameters["wave_damping"] = Parameter(self.waves.damping, "1", chosen)
        for name in ("bias_time", "thruster_time"):
            if getattr(self, name) is not None:
                parameters[name] = Parameter(getattr(self, name), "s", chosen)
        return parameters
