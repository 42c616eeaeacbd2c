"""The base of a robot on legs, on simulated trots, against an invariant filter written apart from the library."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import covariant
from covariant import models
from covariant.models import robots
from covariant.observers import StateNoise, legged_base, run
from covariant.signals import Record

TWO_FEET = {"parameters.path": "quadruped", "parameters.feet": {"FL_FOOT": [0.0, 0.0, 0.0], "HR_FOOT": [0.0, 0.0, 0.0]}}


def test_what_is_no_leg_is_refused():
    space = robots.load("quadruped", floating=True).space
    with pytest.raises(ValueError, match=r"FL_SHOULDER is carried by 1 joints; a foot needs three or more"):
        robots.legs(space, {"FL_SHOULDER": [0.0, 0.0, 0.0]}, 0.0)
    with pytest.raises(ValueError, match=r"\{LINK: \[x, y, z\]\}"):
        robots.legs(space, {"FL_LOWER_LEG": [0.0, 0.0]}, 0.0)
    with pytest.raises(ValueError, match="how the legs move is no part of the model"):
        covariant.simulate("legged_base", duration=0.1, overrides=TWO_FEET)
    with pytest.raises(ValueError, match="the base must be free"):
        robots.legs(robots.load("panda").space, {"link7": [0.0, 0.0, 0.0]}, 0.0)


HIPS = np.array([[0.2, 0.1, 0.0], [0.2, -0.1, 0.0], [-0.2, 0.1, 0.0], [-0.2, -0.1, 0.0]])
STEP, ENCODER, GRAVITY = 0.002, 3e-4, np.array([0.0, 0.0, -9.81])


def on_sliding_legs(folder):
    """Observer of a base on four legs of three sliding joints, which are at the position of a foot from its hip."""
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    parts = [f'<link name="base">{body}</link>']
    for i, hip in enumerate(HIPS):
        for parent, axis in zip(("base", f"{i}x", f"{i}y"), "xyz", strict=True):
            origin, direction = hip if axis == "x" else np.zeros(3), [int(axis == each) for each in "xyz"]
            parts.append(
                f'<link name="{i}{axis}">{body}</link><joint name="joint{i}{axis}" type="prismatic">'
                f'<parent link="{parent}"/><child link="{i}{axis}"/><origin xyz="{" ".join(map(str, origin))}"/>'
                f'<axis xyz="{" ".join(map(str, direction))}"/>'
                '<limit lower="-2" upper="2" effort="1" velocity="9"/></joint>'
            )
    path = folder / "sliding.urdf"
    path.write_text(f'<robot name="sliding">{"".join(parts)}</robot>')
    feet = {f"parameters.feet.{i}z": [0.0, 0.0, 0.0] for i in range(len(HIPS))}
    file = models.load("legged_base", {"parameters.path": str(path), "measurement.std": ENCODER, **feet})
    process, first = (np.diag(np.square(std)) for std in (file.process_std, file.initial_std))
    start = np.asarray(file.initial_state)
    return legged_base(file.model, StateNoise(process, ENCODER**2 * np.eye(12), start, first, 1 / STEP))


def test_a_tilted_start_leaves_gravity_and_biases_consistent(tmp_path):
    """Without noise: a base that starts tilted by .2 rad with large biases, and nods on its standing feet."""
    t = STEP * np.arange(501)
    nods = 0.15 * np.clip(t - 0.4, 0, None) / 0.6 * np.array([np.sin(9 * t), np.cos(7 * t), 0 * t])
    attitude = Rotation.from_rotvec([0.16, 0.12, 0.0]) * Rotation.from_rotvec(nods.T)
    rate = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / STEP
    halfway = attitude[:-1] * Rotation.from_rotvec(rate * STEP / 2)
    feet = attitude[0].apply(HIPS - [0.0, 0.0, 0.3])
    y = np.stack([(attitude[:-1].inv().apply(foot) - hip) for foot, hip in zip(feet, HIPS, strict=True)], axis=1)
    bias = np.array([0.03, -0.03, 0.03, 0.4, -0.3, 0.3])
    u = np.concatenate([rate, -halfway.inv().apply(GRAVITY)], axis=1) + bias
    found = run(on_sliding_legs(tmp_path), Record(t[:-1], u, y.reshape(500, 12)))
    assert np.asarray(found.info.standing).all()
    x, std = np.asarray(found.estimate), np.asarray(found.info.state_std)
    np.testing.assert_allclose(np.linalg.norm(x[:, 3:6], axis=1), 9.81, atol=1e-6)
    true = np.concatenate([np.zeros(3), attitude[-2].inv().apply(GRAVITY), bias])
    settled = np.concatenate([np.arange(6), np.arange(18, 24)])
    assert (np.abs(x[-1, settled] - true) < 0.5 * std[-1, settled]).all()
