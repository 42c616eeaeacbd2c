"""Pendulum chains against MuJoCo, which knows bodies and joints but no metric."""

import importlib.util
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from covariant import models

REPOSITORY = Path(__file__).parents[2]
STATES = 20


def accelerations(model, q, v, u):
    return np.asarray(jax.jit(jax.vmap(lambda *x: models.acceleration(model, jnp.zeros(()), *x)))(q, v, u))


def states(n: int, seed: int) -> np.ndarray:
    """Angles over more than a turn, fast velocities, torques."""
    rng = np.random.default_rng(seed)
    scale = np.array([4.0, 20.0, 3.0])[:, None, None]
    return scale * rng.uniform(-1, 1, (3, STATES, n))


def assert_same(ours, theirs):
    size = np.linalg.norm(theirs, axis=1).max()
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10 * size)


def test_demonstration_is_close_but_no_fairy_tale(monkeypatch):
    """Data sheet and machine differ, and by no more than the example says."""
    monkeypatch.chdir(REPOSITORY)
    demo = load_demo()
    parameters = models.load(demo.MODEL).model.parameters
    machine = mujoco.MjModel.from_xml_string(demo.MACHINE)
    found = {"mass": machine.body_mass, "com": -machine.body_ipos[:, 2], "inertia": machine.body_inertia[:, 0]}
    for name, real in found.items():
        ratio = real[1:] / np.array(parameters[name].value)
        assert (ratio != 1).all(), name
        assert (np.abs(ratio - 1) < 0.021).all(), name


@pytest.mark.core(1)
@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("angles", ["relative", "absolute"])
@pytest.mark.parametrize("zero", ["hanging", "upright"])
def test_geared_chain(n, angles, zero):
    """Any chain: MuJoCo turns the rotors as bodies of their own, and its equations are projected on the gears."""
    rng = np.random.default_rng(n)
    names = ("mass", "length", "com", "inertia", "rotor_inertia", "viscous")
    p = {name: rng.uniform(0.2, 1.0, n) for name in names} | {"gear": rng.uniform(-8, 8, n)}
    given = {name: tuple(value) for name, value in p.items()}
    model = models.pendulum_chain(**given, angles=angles, zero=zero)

    q, v, u = states(n, seed=10 + n)
    joints = np.eye(n) if angles == "relative" else np.eye(n) - np.eye(n, k=-1)  # joint angles from the chart's
    hanging = np.zeros(n) if zero == "hanging" else np.pi * np.eye(n)[0]
    rows = zip(q @ joints.T + hanging, v @ joints.T, u, strict=True)
    theirs = np.stack([geared_acceleration(p, *row) for row in rows])
    assert_same(accelerations(model, q, v, u) @ joints.T, theirs)


def load_demo():
    spec = importlib.util.spec_from_file_location("demo", REPOSITORY / "gallery/demo.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_demo_shows_velocities_first(tmp_path, monkeypatch, capsys):
    """What takes longer comes after the first picture: the comparison, and the log that only another page reads."""
    demo, done = load_demo(), []
    monkeypatch.setattr(demo, "move", lambda out, name: done.append(name))
    monkeypatch.setattr(demo, "covariant", lambda verb, *arguments: done.append(verb))
    monkeypatch.setattr(sys, "argv", ["demo.py", "--out", str(tmp_path)])
    monkeypatch.chdir(tmp_path)
    demo.main()
    assert done == ["log.csv", "estimate", "compare", "other.csv"]
    assert "estimate.html" in capsys.readouterr().out.partition("Next")[0]


def chain_xml(p) -> str:
    """Links that hang at zero, each beside the rotor of its joint on the link before; MuJoCo needs a mass for all."""
    body = ""
    for i in reversed(range(len(p["mass"]))):
        at = f"0 0 {-p['length'][i - 1] if i else 0.0}"
        m, c, inertia, rotor, damping = (p[k][i] for k in ("mass", "com", "inertia", "rotor_inertia", "viscous"))
        body = f"""
        <body pos="{at}">
          <joint name="rotor{i}" axis="0 1 0"/>
          <inertial mass="1e-14" pos="0 0 0" diaginertia="{rotor} {rotor} {rotor}"/>
        </body>
        <body pos="{at}">
          <joint name="link{i}" axis="0 1 0" damping="{damping}"/>
          <inertial mass="{m}" pos="0 0 {-c}" diaginertia="{inertia} {inertia} {inertia}"/>
          {body}
        </body>"""
    flag = '<option gravity="0 0 -9.81"><flag contact="disable"/></option>'
    return f"<mujoco>{flag}<worldbody>{body}</worldbody></mujoco>"


def geared_acceleration(p, q, v, u) -> np.ndarray:
    """`(GᵀMG)⁻¹ (u + Gᵀ(passive − bias))`; G takes joint rates to those of links and rotors."""
    n = len(q)
    machine = mujoco.MjModel.from_xml_string(chain_xml(p))
    data = mujoco.MjData(machine)
    rates = np.zeros((2 * n, n))
    for i in range(n):
        rates[machine.joint(f"link{i}").dofadr[0], i] = 1.0
        rates[machine.joint(f"rotor{i}").dofadr[0], i] = -p["gear"][i]
    data.qpos, data.qvel = rates @ q, rates @ v
    mujoco.mj_forward(machine, data)
    momenta = np.zeros((n, 2 * n))
    for momentum, rate in zip(momenta, rates.T, strict=True):
        mujoco.mj_mulM(machine, data, momentum, np.ascontiguousarray(rate))
    force = u + rates.T @ (data.qfrc_passive - data.qfrc_bias)
    return np.linalg.solve(momenta @ rates, force)
