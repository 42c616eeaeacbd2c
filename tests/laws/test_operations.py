"""The operations of generated code, all turns of loops counted, are those of the table in `operations.json`.

They are the same on every machine, and say what a step costs. To change one, write the table again by
`python tests/laws/test_operations.py`, or rows of it with their names behind, and say in the commit why.
"""

import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import scalargraph
from covariant import codegen, models, observers
from covariant.models import input_count, robots
from scalargraph import operations

TABLE = Path(__file__).with_name("operations.json")


class System(NamedTuple):
    """A model and the link that has a gyro, if it is a robot."""

    model: models.MechanicalSystem
    link: str | None = None


SYSTEMS: dict[str, Callable[[], System]] = {
    "double pendulum": lambda: System(models.pendulum_chain()),
    "top": lambda: System(models.heavy_top()),
    "SCARA": lambda: System(robots.load("scara"), "hand"),
    "Panda": lambda: System(robots.load("panda"), "panda_link7"),
    "quadruped": lambda: System(robots.load("quadruped"), "base_link"),
}


def intrinsic(system: System) -> observers.AbstractObserver:
    return observers.Intrinsic(system.model, 50.0, 1250.0, substeps=1)


def measured(system: System) -> observers.AbstractObserver:
    return observers.MeasuredCoefficients(system.model, 50.0, 1250.0, 1.0)


def kalman(system: System, *sensors: observers.Sensor) -> observers.AbstractObserver:
    n = dimension(system)
    covariances = 0.1 * jnp.eye(n), 1e-8 * jnp.eye(n), jnp.eye(n)
    return observers.IntrinsicKalman(system.model, *covariances, substeps=1, sensors=sensors)


def ekf(system: System) -> observers.AbstractObserver:
    n = dimension(system)
    return observers.EKF(system.model, 0.1 * jnp.eye(n), 1e-8 * jnp.eye(n), 1.0, substeps=1)


OBSERVERS: dict[str, Callable[[System], observers.AbstractObserver]] = {
    "intrinsic": intrinsic,
    "gated": lambda system: observers.Gated(intrinsic(system), system.model, 1e-3, 1.0, fast_start=True),
    "measured": lambda system: observers.Gated(measured(system), system.model, 1e-3, 1.0, fast_start=True),
    "delayed": lambda system: observers.Delayed(intrinsic(system), 0.01, 250.0),
    "geodesic": lambda system: observers.Geodesic(system.model, 50.0, 1250.0, substeps=1),
    "ekf": ekf,
    "kalman": kalman,
    "kalman with a gyro": lambda system: kalman(system, observers.gyro(system.model.space, system.link, 0.01)),
}
SHORT = {
    "double pendulum": ("intrinsic", "gated", "delayed", "geodesic", "ekf", "kalman"),
    "top": ("intrinsic", "gated"),
    "SCARA": ("intrinsic", "gated"),
    "Panda": ("intrinsic", "measured"),
}
"""Steps that the short suite counts."""
LONG = {
    "top": ("delayed", "geodesic", "kalman"),
    "SCARA": ("delayed", "geodesic", "ekf", "kalman", "kalman with a gyro"),
    "Panda": ("gated", "ekf"),
    "quadruped": ("intrinsic",),
}
"""Steps that the long suite counts."""
EXHAUSTIVE = {"Panda": ("geodesic", "kalman")}
"""Steps whose graphs take a minute or more."""


@functools.cache
def made(system: str) -> System:
    return SYSTEMS[system]()


def right_hand_side(system: System) -> tuple[Callable, tuple[jax.Array, ...]]:
    """That of the observer with constant gains, and its arguments."""
    observer, y = intrinsic(system), system.model.manifold.origin()
    state = observer.init(y)

    def flow(q, v, u, y):
        rate: Any = observer.flow(jnp.zeros(()), state._replace(q=q, v=v), u, y)
        return rate.q, rate.v

    return flow, (state.q, state.v, inputs(system), y)


def inputs(system: System) -> jax.Array:
    return jnp.zeros(input_count(system.model, dimension(system)))


def dimension(system: System) -> int:
    manifold = system.model.manifold
    return manifold.zero(manifold.origin()).shape[0]


def of_right_hand_side(name: str) -> int:
    function, arguments = right_hand_side(made(name))
    return operations(scalargraph.lower(function, *arguments, loops="any").graph.nodes)


def of_enclosure(name: str) -> int:
    """Of the right-hand side with its slopes in q and v, whose bounds are a proof."""
    function, arguments = right_hand_side(made(name))
    lowered = scalargraph.lower(function, *arguments, real=True)
    return operations(scalargraph.expand(lowered, range(arguments[0].size + arguments[1].size), 1).graph.nodes)


def of_step(name: str, observer: str) -> int:
    system = made(name)
    step = OBSERVERS[observer](system)
    q = system.model.manifold.origin()
    readings = sum(sensor.count for sensor in getattr(step, "sensors", ()))
    y = np.concatenate([q, np.zeros(readings)]) if readings else np.asarray(q)
    program = codegen.program(codegen.Recipe(lambda numbers: step, {}), y, loops=True)
    return operations(program.step.graph.nodes)


def counts() -> list:
    """The name and the count of each row, marked `long` where it takes more than a few seconds."""
    rows = []
    for name in SYSTEMS:
        marks = [pytest.mark.long] if name not in SHORT else []
        rows.append(pytest.param(f"{name}, right-hand side", functools.partial(of_right_hand_side, name), marks=marks))
    for name in ("double pendulum", "top"):
        rows.append(pytest.param(f"{name}, enclosure", functools.partial(of_enclosure, name)))
    for suite, marks in ((SHORT, []), (LONG, [pytest.mark.long]), (EXHAUSTIVE, [pytest.mark.exhaustive])):
        for name, steps in suite.items():
            for step in steps:
                count = functools.partial(of_step, name, step)
                rows.append(pytest.param(f"{name}, step, {step}", count, marks=marks))
    return rows


def test_the_table_has_these_rows_alone():
    assert list(json.loads(TABLE.read_text(encoding="utf-8"))) == [row.values[0] for row in counts()]


def main(names: list[str]) -> int:
    """Write the table, or the rows of these names alone, printing what changes; returns 0."""
    old = json.loads(TABLE.read_text(encoding="utf-8")) if TABLE.exists() else {}
    table = {}
    for name, count in (row.values for row in counts()):
        table[name] = count() if not names or name in names else old.get(name)
        if table[name] != old.get(name):
            print(f"{name}: {table[name]}, was {old.get(name)}", flush=True)
    TABLE.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
