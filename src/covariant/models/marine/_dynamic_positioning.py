"""A ship in dynamic positioning: first-order wave motion, slowly varying forces, and thrusters with a lag.

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


class Waves(eqx.Module):
    """Wave motion of north, east and heading: `ξ₁' = ξ₂`, `ξ₂' = −ω²ξ₁ − 2ζωξ₂ + w`, of which ξ₂ is measured.

    - `frequency` (3,): ω [rad/s].
    - `damping` (3,): ζ, relative.
    - `intensity` (3,): root of the spectral density of the white noise w, so that the standard deviation of the motion
      is `intensity / (2 √(ζω))` [m, m, rad].

    Raises `ValueError` where an entry is not positive.
    """

    frequency: tuple[float, ...] = eqx.field(static=True)
    damping: tuple[float, ...] = eqx.field(static=True)
    intensity: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, frequency: Sequence[float], damping: Sequence[float], std: Sequence[float]):
        """`std` (3,): standard deviation of the motion in north and east [m] and heading [rad]."""
        for name, entries in (("frequency", frequency), ("damping", damping), ("std", std)):
            if len(entries) != 3 or not all(0 < entry < np.inf for entry in entries):
                raise ValueError(f"waves: {name} needs three positive numbers, for north, east, heading; got {entries}")
        self.frequency, self.damping = tuple(frequency), tuple(damping)
        self.intensity = tuple(2 * s * (z * w) ** 0.5 for s, z, w in zip(std, damping, frequency, strict=True))


class Station(eqx.Module):
    """A surface ship with the disturbances at sea; beside η and ν its states are those of the parts it has.

    - `ship`: a `Craft` in the plane, such as `supply_vessel()`.
    - `waves`: wave motion ξ (6,), added to the measured position.
    - `bias_time`: a slowly varying force b (3,) in north, east and heading [N, N, N m] is part of the state, a Markov
      process with this time constant [s]; infinity makes it a random walk.
    - `thruster_time`: the force τ (3,) follows the commanded one with this time constant [s].

    States are in this order: η, ν, ξ, b, τ. Raises `ValueError` for a craft that is not planar or a time that is not
    positive.
    """

    ship: Craft
    waves: Waves | None = None
    bias_time: float | None = eqx.field(default=None, static=True)
    thruster_time: float | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        if self.ship.coordinates != ("north", "east", "heading"):
            raise ValueError(f"a station needs a ship in the plane; this craft has {', '.join(self.ship.coordinates)}")
        for name, time in (("bias_time", self.bias_time), ("thruster_time", self.thruster_time)):
            if time is not None and not time > 0:
                raise ValueError(f"station: {name} must be positive [s]; got {time}")

    @property
    def parts(self) -> dict[str, slice]:
        """The slice of each part of the state: eta, nu, and waves, bias and thrust where the station has them."""
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
        """x' (n,) under the commanded force u (3,), with rotations by `heading`, measured or that of the state.

        `noise` drives the waves and the bias, three entries each: white noise of unit spectral density for the waves,
        and [N/√s, N/√s, N m/√s] for the bias.
        """
        part = {name: x[where] for name, where in self.parts.items()}
        turn = yaw_rotation(heading)
        eta, nu = part["eta"], part["nu"]
        force = part.get("thrust", u)
        if "bias" in part:
            force = force + turn.T @ part["bias"]
        drive = jnp.zeros(3 * (("waves" in part) + ("bias" in part)), x.dtype) if noise is None else noise
        rates = [turn @ nu, self.ship.acceleration(eta.at[2].set(heading), nu, force)]
        if self.waves is not None:
            w, z, k = (
                jnp.asarray(a, x.dtype) for a in (self.waves.frequency, self.waves.damping, self.waves.intensity)
            )
            place, speed = jnp.split(part["waves"], 2)
            rates += [speed, -(w**2) * place - 2 * z * w * speed + k * drive[:3]]
        if self.bias_time is not None:
            rates.append(-part["bias"] / self.bias_time + drive[-3:])
        if self.thruster_time is not None:
            rates.append((u - part["thrust"]) / self.thruster_time)
        return jnp.concatenate(rates)

    def output(self, x: Vector) -> Float[Array, "3"]:
        """The measured north, east and heading: position plus wave motion."""
        eta = x[self.parts["eta"]]
        return eta if self.waves is None else eta + x[self.parts["waves"]][3:]

    def model(self, noise: bool = False) -> StateSpace:
        """The station as a `StateSpace`; with `noise` the inputs of waves and bias follow the force in u."""
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
        found = dict(self.ship.parameters)
        if self.waves is not None:
            found["wave_frequency"] = Parameter(self.waves.frequency, "rad/s", chosen)
            found["wave_damping"] = Parameter(self.waves.damping, "1", chosen)
        for name in ("bias_time", "thruster_time"):
            if getattr(self, name) is not None:
                found[name] = Parameter(getattr(self, name), "s", chosen)
        return found
