"""Pendulum chains against MuJoCo, which knows bodies and joints but no metric: what takes long."""

import mujoco
import numpy as np
import pytest
from test_mujoco import REPOSITORY, STATES, accelerations, assert_same, load_demo, states

from covariant import models


@pytest.mark.parametrize("damped", [False, True])
def test_demonstration(damped, monkeypatch):
    """The example's parameters, put into the machine of the demonstration: the same chart, inputs and accelerations."""
    monkeypatch.chdir(REPOSITORY)
    demo = load_demo()
    still = ["parameters.coulomb=[0.0, 0.0]", *([] if damped else ["parameters.viscous=[0.0, 0.0]"])]
    model = models.load(demo.MODEL, still).model
    machine = mujoco.MjModel.from_xml_string(demo.MACHINE)
    data = mujoco.MjData(machine)
    overwrite(machine, data, {name: np.array(p.value) for name, p in model.parameters.items()})

    q, v, u = states(2, seed=1)
    theirs = np.empty((STATES, 2))
    for i in range(STATES):
        data.qpos, data.qvel, data.ctrl = q[i], v[i], u[i]
        mujoco.mj_forward(machine, data)
        theirs[i] = data.qacc
    assert_same(accelerations(model, q, v, u), theirs)


def overwrite(machine, data, parameters) -> None:
    """Give the machine the parameters of a model, and no dry friction."""
    machine.body_mass[1:] = parameters["mass"]
    machine.body_ipos[1:, 2] = -parameters["com"]
    machine.body_inertia[1:, :2] = parameters["inertia"][:, None]
    machine.body_pos[2:, 2] = -parameters["length"][:-1]
    machine.dof_damping[:] = parameters["viscous"]
    machine.dof_frictionloss[:] = 0.0
    mujoco.mj_setConst(machine, data)
