"""The systems of `information.py`: reads them from information.toml, and defines those that the library does not."""

import copy
import functools
import re
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from covariant import models

GRAVITY = 9.81
LINK = """<link name="l{k}"><inertial><origin xyz="0 0 -0.15"/><mass value="{mass}"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j{k}" type="continuous"><origin xyz="0 0 {z}"/><parent link="l{parent}"/><child link="l{k}"/>
<axis xyz="{axis}"/></joint>"""
"""A link of an arm without friction and rotors, and its joint."""


@dataclass(frozen=True, eq=False)
class System:
    """A system, the logs that are simulated from it, and the numbers that are fitted; information.toml says more."""

    spec: str
    numbers: list[str]
    model: dict[str, Any]
    first: dict[str, list[float]]
    noise: list[float]
    force: list[float]
    tones: dict[str, Any] | None = None
    zigzag: dict[str, Any] | None = None
    feedback: list[list[float]] | None = None
    correlation: float = 0.05
    rate: float = 200.0
    seconds: tuple[float, float] = (2.0, 10.0)

    @property
    def truth(self) -> np.ndarray:
        """True values (p,) of the numbers."""
        content: list[Any] = [self.model] * len(self.numbers)
        for k, name in enumerate(self.numbers):
            for key in _keys(name):
                content[k] = content[k][key]
        return np.array(content, float)

    def _with(self, values: Iterable[Any]) -> dict[str, Any]:
        """The tables of the model file with other values of the numbers."""
        filled = copy.deepcopy(self.model)
        for name, value in zip(self.numbers, values, strict=True):
            *keys, last = _keys(name)
            table: Any = filled
            for key in keys:
                table = table[key]
            table[last] = value
        return filled

    def overrides(self, values: np.ndarray) -> dict[str, Any]:
        """What `covariant.fit` is told: the tables with these values of the numbers, and the noise of the outputs."""
        content = self._with(values.tolist()).items()
        std = self.noise[0] if len(set(self.noise)) == 1 else self.noise  # a group takes one number
        tables = {f"{table}.{key}": value for table, entries in content for key, value in entries.items()}
        return tables | {"measurement.std": std, "inputs.between": "held"}

    @functools.cached_property
    def make(self) -> Callable[[jax.Array], Any]:
        """Function that builds the model from the numbers (p,), which may be traced."""
        if self.spec.endswith(".urdf"):
            family = models.robot_family(self.spec, self.numbers, self.overrides(self.truth))
            return lambda values: family.make(values - family.first)
        room = models.marine if self.spec == "manoeuvring_ship" else models
        build = models.attribute(self.spec) if ":" in self.spec else getattr(room, self.spec)
        return lambda values: build(**self._with(values)["parameters"])

    def inputs(self, random: np.random.Generator) -> np.ndarray:
        """Inputs (T, m), before feedback, of the longest log: tones with random frequencies, or zig-zags."""
        t = np.arange(round(self.seconds[1] * self.rate)) / self.rate
        if self.zigzag is not None:
            turns = t / np.array([[random.uniform(*self.zigzag["period"])], [60.0]]) + random.uniform(size=(2, 1))
            rudder, speed = np.sin(2 * np.pi * turns)
            angle = random.uniform(*self.zigzag["angle"]) * np.sign(rudder)
            return np.stack([angle, self.zigzag["revolutions"] + self.zigzag["change"] * speed], axis=1)
        tones = self.tones or {}
        shape = (3, len(tones["size"]))
        frequency = np.exp(random.uniform(np.log(tones["low"]), np.log(tones["high"]), shape))
        waves = np.sin(2 * np.pi * (frequency * t[:, None, None] + random.uniform(size=shape)))
        return np.array(tones.get("mean", 0.0)) + np.array(tones["size"]) * np.sqrt(2 / 3) * waves.sum(axis=1)


def _keys(name: str) -> list[str | int]:
    """Keys of a number in the tables of a model file."""
    keys = [int(key) if key.isdigit() else key for key in re.split(r"[.\[\]]+", name.removesuffix("]"))]
    return keys if keys[0] == "servo" else ["parameters", *keys]


def systems(folder: Path) -> dict[str, System]:
    """All systems by name; URDF files are written to a folder."""
    tables = tomllib.loads(Path(__file__).with_name("information.toml").read_text())
    for name, table in tables.items():
        if axes := table.pop("axes", None):
            links = [
                LINK.format(k=k, parent=k - 1, axis=axis, z=-0.3 * (k > 1), mass=1 / k)
                for k, axis in enumerate(axes, 1)
            ]
            path = folder / f"{name.replace(' ', '_')}.urdf"
            path.write_text('<robot name="arm"><link name="l0"/>' + "\n".join(links) + "</robot>")
            table["spec"] = str(path)
    return {name: System(**table) for name, table in tables.items()}


def _driven(inertia: Callable, potential: Callable, friction: list, coordinates: dict[str, str], inputs: int):
    """A machine with forces on its first coordinates, viscous friction, and an angle as its last one."""
    return models.Lagrangian(
        inertia,
        potential,
        lambda t, q, u: jnp.pad(u, (0, len(coordinates) - inputs)),
        lambda q, v: -jnp.stack([jnp.asarray(each) * rate for each, rate in zip(friction, v, strict=True)]),
        circles=(len(coordinates) - 1,),
        coordinates=tuple(coordinates),
        units=tuple(coordinates.values()),
        inputs=inputs,
    )


def cart_pole(cart, pole, length, cart_friction, pole_friction):
    """A cart with a hanging mass on a rod; the input is a force on the cart."""

    def inertia(q):
        cross = pole * length * jnp.cos(q[1])
        return jnp.array([[cart + pole, cross], [cross, pole * length**2]])

    friction, names = [cart_friction, pole_friction], {"x": "m", "theta": "rad"}
    return _driven(inertia, lambda q: -pole * length * GRAVITY * jnp.cos(q[1]), friction, names, 1)


def furuta(arm, pendulum, length, reach, arm_friction, pendulum_friction):
    """Furuta pendulum with inertias of the arm and of the pendulum, a mass at a length; torque on the arm."""
    mass = pendulum / length**2

    def inertia(q):
        cross = mass * reach * length * jnp.cos(q[1])
        return jnp.array([[arm + mass * reach**2 + pendulum * jnp.sin(q[1]) ** 2, cross], [cross, pendulum]])

    friction, names = [arm_friction, pendulum_friction], {"arm": "rad", "theta": "rad"}
    return _driven(inertia, lambda q: -mass * length * GRAVITY * jnp.cos(q[1]), friction, names, 1)


def gantry(trolley, hoist, load, trolley_friction, hoist_friction):
    """Gantry crane; forces on the trolley and along the rope."""

    def place(q):
        return jnp.array([q[0] + q[1] * jnp.sin(q[2]), -q[1] * jnp.cos(q[2])])

    def inertia(q):
        jacobian = jax.jacfwd(place)(q)
        return load * jacobian.T @ jacobian + jnp.diag(jnp.array([trolley, hoist, 0.0]))

    friction, names = [trolley_friction, hoist_friction, 0.0], {"x": "m", "rope": "m", "theta": "rad"}
    return _driven(inertia, lambda q: load * GRAVITY * place(q)[1], friction, names, 2)


def dc_motor(resistance, inductance, constant, inertia, viscous):
    """A motor whose current is measured, and not its speed; the input is a voltage."""

    def rate(t, x, u):
        current = (u[0] - resistance * x[0] - constant * x[1]) / inductance
        return jnp.stack([current, (constant * x[0] - viscous * x[1]) / inertia])

    return models.StateSpace(
        rate, lambda t, x, u: x[:1], coordinates=("current", "speed"), units=("A", "rad/s"), outputs=("i",), inputs=1
    )
