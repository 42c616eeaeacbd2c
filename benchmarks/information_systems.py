"""The twelve simulated systems of `information.py`: models, true numbers, inputs, noise and unknown forces."""

import copy
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from covariant import models

Inputs = Callable[[np.random.Generator, np.ndarray], np.ndarray]
"""Inputs (T, m) at stamps (T,)."""
GRAVITY = 9.81


class Case(NamedTuple):
    """A system, the logs that are simulated from it, and the numbers that are fitted.

    Attributes:
        spec: The model as `covariant.fit` takes it.
        build: Function that builds the model from its parameters; None for a robot.
        content: Tables of the model file with the true numbers.
        numbers: Names of the open numbers.
        inputs: Inputs before feedback.
        centre, spread: First states are uniform in centre ± spread, in coordinates at the origin.
        std: Standard deviation of each output [its unit].
        force: RMS of the unknown force: of each generalised force, or of each input of a `StateSpace`.
        correlation: Correlation time of the force [s].
        rate, seconds: Rows per second, and the range of durations.
        feedback: Gains (m, N) by which the inputs of an unstable system depend on the true state.
    """

    spec: str
    build: Callable[..., Any] | None
    content: dict[str, Any]
    numbers: tuple[str, ...]
    inputs: Inputs
    centre: Sequence[float]
    spread: Sequence[float]
    std: Sequence[float]
    force: Sequence[float]
    correlation: float = 0.05
    rate: float = 200.0
    seconds: tuple[float, float] = (2.0, 10.0)
    feedback: Sequence[Sequence[float]] | None = None

    @property
    def truth(self) -> np.ndarray:
        """True values (p,) of the open numbers."""
        return np.array([_entry(self.content, name) for name in self.numbers], float)

    def overrides(self, values: Sequence[float]) -> dict[str, Any]:
        """All that the model file states, with these values of the open numbers."""
        content = _filled(self.content, self.numbers, map(float, values))
        tables = {f"{table}.{key}": value for table, entries in content.items() for key, value in entries.items()}
        std = self.std[0] if len(set(self.std)) == 1 else list(self.std)  # a group takes one number
        return tables | {"measurement.std": std, "inputs.between": "held"}

    def model(self) -> Callable[[jax.Array], Any]:
        """Function that builds the model from the open numbers (p,), which may be traced."""
        if self.build is not None:
            build = self.build
            return lambda values: build(**_filled(self.content, self.numbers, values)["parameters"])
        family = models.robot_family(self.spec, self.numbers, self.overrides(self.truth))
        return lambda values: family.make(values - family.first)


def _keys(name: str) -> list[str | int]:
    """Keys of a number in the tables of a model file."""
    keys = [int(key) if key.isdigit() else key for key in re.split(r"[.\[\]]+", name.removesuffix("]"))]
    return keys if keys[0] == "servo" else ["parameters", *keys]


def _entry(content: Any, name: str) -> float:
    for key in _keys(name):
        content = content[key]
    return content


def _filled(content: dict[str, Any], numbers: Sequence[str], values: Any) -> dict[str, Any]:
    """Copy tables with other values of the open numbers."""
    filled = copy.deepcopy(content)
    for name, value in zip(numbers, values, strict=True):
        *keys, last = _keys(name)
        table: Any = filled
        for key in keys:
            table = table[key]
        table[last] = value
    return filled


def tones(sizes: Sequence[float], low: float, high: float, means: Sequence[float] | float = 0.0) -> Inputs:
    """Three tones an input, between these frequencies [Hz], with random phases."""

    def inputs(random: np.random.Generator, t: np.ndarray) -> np.ndarray:
        shape = (3, len(sizes))
        frequency, phase = np.exp(random.uniform(np.log(low), np.log(high), shape)), random.uniform(0, 2 * np.pi, shape)
        return means + np.asarray(sizes) * np.sin(2 * np.pi * frequency * t[:, None, None] + phase).sum(1) / np.sqrt(3)

    return inputs


def zigzag(random: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Rudder angle [rad] that changes its side in random periods, and revolutions [1/s] that change slowly."""
    period, phase = random.uniform(15, 30), random.uniform(0, 1, 2)
    rudder = random.uniform(0.2, 0.4) * np.sign(np.sin(2 * np.pi * (t / period + phase[0])))
    return np.stack([rudder, 10 + 1.5 * np.sin(2 * np.pi * (t / 60 + phase[1]))], axis=1)


def cart_pole(cart, pole, length, cart_friction, pole_friction):
    """A cart with a hanging point mass on a rod; a force on the cart."""
    off = pole * length
    return models.Lagrangian(
        lambda q: jnp.array([[cart + pole, off * jnp.cos(q[1])], [off * jnp.cos(q[1]), off * length]]),
        lambda q: -off * GRAVITY * jnp.cos(q[1]),
        lambda t, q, u: jnp.array([u[0], 0.0]),
        lambda q, v: -jnp.array([cart_friction, pole_friction]) * v,
        circles=(1,),
        coordinates=("x", "theta"),
        units=("m", "rad"),
        inputs=1,
    )


def furuta(arm, pendulum, length, reach, arm_friction, pendulum_friction):
    """Furuta pendulum: inertias of the arm and of the pendulum [kg m²], whose mass is pendulum/length²."""
    mass = pendulum / length**2
    cross = mass * reach * length

    def inertia(q):
        corner = arm + mass * reach**2 + pendulum * jnp.sin(q[1]) ** 2
        return jnp.array([[corner, cross * jnp.cos(q[1])], [cross * jnp.cos(q[1]), pendulum]])

    return models.Lagrangian(
        inertia,
        lambda q: -mass * length * GRAVITY * jnp.cos(q[1]),
        lambda t, q, u: jnp.array([u[0], 0.0]),
        lambda q, v: -jnp.array([arm_friction, pendulum_friction]) * v,
        circles=(0, 1),
        coordinates=("arm", "pendulum"),
        units=("rad", "rad"),
        inputs=1,
    )


def gantry(trolley, hoist, load, trolley_friction, hoist_friction):
    """Gantry crane: trolley x, length of the rope, angle of the load; forces on trolley and rope."""

    def inertia(q):
        def place(q):
            return jnp.array([q[0] + q[1] * jnp.sin(q[2]), -q[1] * jnp.cos(q[2])])

        jacobian = jax.jacfwd(place)(q)
        return load * jacobian.T @ jacobian + jnp.diag(jnp.array([trolley, hoist, 0.0]))

    return models.Lagrangian(
        inertia,
        lambda q: -load * GRAVITY * q[1] * jnp.cos(q[2]),
        lambda t, q, u: jnp.array([u[0], u[1], 0.0]),
        lambda q, v: -jnp.array([trolley_friction, hoist_friction, 0.0]) * v,
        circles=(2,),
        coordinates=("x", "rope", "theta"),
        units=("m", "m", "rad"),
        inputs=2,
    )


def dc_motor(resistance, inductance, constant, inertia, viscous):
    """A motor whose current is measured, and not its speed; the input is a voltage."""

    def rate(t, x, u):
        current = (u[0] - resistance * x[0] - constant * x[1]) / inductance
        return jnp.stack([current, (constant * x[0] - viscous * x[1]) / inertia])

    return models.StateSpace(
        rate, lambda t, x, u: x[:1], coordinates=("current", "speed"), units=("A", "rad/s"), outputs=("i",), inputs=1
    )


LINK = """<link name="{name}"><inertial><origin xyz="0 0 -{com}"/><mass value="{mass}"/>
<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j{number}" type="continuous"><origin xyz="0 0 {z}"/><parent link="{parent}"/><child link="{name}"/>
<axis xyz="{axis}"/></joint>"""


def urdf(folder: Path, axes: Sequence[str]) -> str:
    """Path of the URDF file of an arm with an axis for each joint, without friction and rotors."""
    links = [
        LINK.format(
            name=f"l{k}", parent=f"l{k - 1}", number=k, axis=axis, z=-0.3 * (k > 1), com=0.15, mass=1 / k, i=0.01
        )
        for k, axis in enumerate(axes, 1)
    ]
    path = folder / f"arm{len(axes)}.urdf"
    path.write_text('<robot name="arm"><link name="l0"/>' + "\n".join(links) + "</robot>")
    return str(path)


def cases(folder: Path) -> dict[str, Case]:
    """All systems by name; URDF files are written to a folder."""

    def case(spec, build, parameters, numbers, *rest, servo=None, **others):
        tables = {"servo": servo, "inputs": {"kind": "command"}} if servo else {}
        return Case(spec, build, {"parameters": parameters, **tables}, numbers, *rest, **others)

    chain, own = models.pendulum_chain, "information_systems:"
    single = {"mass": [0.6], "length": [0.3], "com": [0.2], "inertia": [0.006], "viscous": [0.02]}
    double = {
        "mass": [0.6, 0.4],
        "length": [0.3, 0.25],
        "com": [0.16, 0.14],
        "inertia": [5e-3, 2.6e-3],
        "viscous": [0.03, 0.02],
    }
    cart = {"cart": 1.0, "pole": 0.2, "length": 0.4, "cart_friction": 0.8, "pole_friction": 4e-3}
    rotary = {"arm": 4e-3, "pendulum": 1.5e-3, "length": 0.13, "reach": 0.15, "arm_friction": 3e-3}
    crane = {"trolley": 2.0, "hoist": 0.5, "load": 1.0, "trolley_friction": 3.0, "hoist_friction": 4.0}
    motor = {"resistance": 1.2, "inductance": 5e-3, "constant": 0.05, "inertia": 1e-4, "viscous": 2e-4}
    vehicle = {
        "added_mass": [5.0, 12.0, 14.0, 0.1, 0.2, 0.2],
        "drag": [4.0, 6.0, 5.0, 0.1, 0.1, 0.1],
        "quadratic_drag": [18.0, 22.0, 37.0, 1.5, 1.5, 1.5],
    }
    joint = {"stiffness": 12.0, "damping": 0.4, "viscous": 0.2, "armature": 0.02}
    hull = {
        name: models.marine.manoeuvring_ship().f.parameters["hull"][name].item() for name in ("R0", "Yv", "Nv", "Nr")
    }
    friction = {"j1": {"viscous": 0.08, "coulomb": 0.05}, "j2": {"viscous": 0.06}, "j3": {"viscous": 0.03}}
    return {
        "pendulum": case(
            "pendulum_chain",
            chain,
            single,
            ("com[0]", "inertia[0]", "viscous[0]"),
            tones([0.5], 0.3, 2.0),
            [0] * 2,
            [1.0, 2.0],
            [5e-4],
            [0.05],
        ),
        "double pendulum": case(
            "pendulum_chain",
            chain,
            double,
            ("mass[0]", "mass[1]", "inertia[1]", "viscous[0]", "viscous[1]"),
            tones([0.5, 0.15], 0.3, 2.0),
            [0] * 4,
            [0.7, 0.7, 1.0, 1.0],
            [5e-4] * 2,
            [0.05, 0.02],
            rate=250.0,
        ),
        "cart-pole": case(
            own + "cart_pole",
            cart_pole,
            cart,
            ("cart", "pole", "cart_friction", "pole_friction"),
            tones([4.0], 0.4, 1.5),
            [0] * 4,
            [0.1, 0.8, 0.3, 1.0],
            [2e-4, 5e-4],
            [0.3, 0.01],
        ),
        "furuta": case(
            own + "furuta",
            furuta,
            rotary | {"pendulum_friction": 2e-4},
            ("arm", "pendulum", "arm_friction", "pendulum_friction"),
            tones([0.06], 0.5, 2.5),
            [0] * 4,
            [0.5, 1.0, 1.0, 2.0],
            [5e-4] * 2,
            [5e-3, 0.0],
            rate=250.0,
        ),
        "gantry": case(
            own + "gantry",
            gantry,
            crane,
            tuple(crane),
            tones([5.0, 3.0], 0.2, 1.0, [0.0, -GRAVITY + 30.0]),
            [0, 1.0, 0, 0, 0, 0],
            [0.2, 0.1, 0.3, 0.2, 0.1, 0.3],
            [5e-4, 5e-4, 1e-3],
            [0.3, 0.3, 0.03],
            rate=100.0,
            feedback=[[10.0, 0, 0, 0, 0, 0], [0, 30.0, 0, 0, 0, 0]],
        ),
        "top": case(
            "heavy_top",
            models.heavy_top,
            {"inertia": [0.2, 0.25, 0.1], "moment": 1.0, "viscous": 0.05},
            ("inertia[0]", "inertia[1]", "inertia[2]", "moment", "viscous"),
            tones([0.5] * 3, 0.2, 1.5),
            [np.pi, 0, 0, 0, 0, 0],
            [0.7, 0.7, 0.7, 1.0, 1.0, 3.0],
            [1e-3] * 3,
            [0.05, 0.05, 0.03],
        ),
        "vehicle": case(
            "underwater_vehicle",
            models.underwater_vehicle,
            vehicle,
            ("added_mass[0]", "added_mass[5]", "drag[0]", "quadratic_drag[0]", "quadratic_drag[5]"),
            tones([40, 30, 30, 1, 1, 2], 0.1, 0.6),
            [0] * 12,
            [0.5] * 6 + [0.3] * 6,
            [3e-3] * 6,
            [1, 1, 1, 0.05, 0.05, 0.05],
            correlation=0.3,
            rate=100.0,
        ),
        "ship": case(
            "manoeuvring_ship",
            models.marine.manoeuvring_ship,
            {"hull": hull},
            tuple(f"hull.{key}" for key in hull),
            zigzag,
            [0, 0, 0, 1.0, 0, 0],
            [1, 1, 0.5, 0.1, 0.05, 0.02],
            [0.02, 0.02, 2e-3],
            [0.02, 0.2],
            correlation=2.0,
            rate=5.0,
            seconds=(120.0, 600.0),
        ),
        "ball and beam": case(
            "ball_and_beam",
            models.ball_and_beam,
            {"mass": 0.1, "inertia": 2.0, "gravity": GRAVITY},
            ("mass", "inertia"),
            tones([3.0], 0.3, 1.0),
            [0] * 4,
            [0.1, 0.05, 0.1, 0.1],
            [5e-4] * 2,
            [0.0, 0.1],
            rate=100.0,
            seconds=(2.0, 6.0),
            feedback=[[-2.0, 27.0, -2.75, 12.0]],
        ),
        "servo arm": case(
            urdf(folder, ["0 1 0"] * 2),
            None,
            {},
            ("servo.j1.stiffness", "servo.j1.damping", "servo.j2.stiffness", "servo.j2.damping", "servo.j2.armature"),
            tones([0.4, 0.5], 0.3, 1.5),
            [0] * 4,
            [0.3] * 4,
            [5e-4] * 2,
            [0.1, 0.05],
            servo={"j1": joint, "j2": joint | {"stiffness": 6.0, "damping": 0.2}},
        ),
        "urdf arm": case(
            urdf(folder, ["0 0 1", "0 1 0", "0 1 0"]),
            None,
            {"friction": friction, "armature": {"j1": 0.02, "j3": 0.01}},
            ("friction.j1.viscous", "friction.j2.viscous", "friction.j3.viscous", "armature.j1", "armature.j3"),
            tones([0.4, 1.5, 0.5], 0.3, 1.5),
            [0] * 6,
            [0.5] * 6,
            [2e-4] * 3,
            [0.04, 0.1, 0.04],
        ),
        "state space": case(
            own + "dc_motor",
            dc_motor,
            motor,
            ("resistance", "inductance", "inertia", "viscous"),
            tones([6.0], 0.5, 8.0),
            [0] * 2,
            [1.0, 20.0],
            [0.02],
            [0.3],
            rate=250.0,
        ),
    }
