"""Reads equalities of MJCF files: joints that follow others, and closed loops. Source: MuJoCo documentation."""

from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from covariant.models.robots._description import Coincide, Coupled, Follows, Joint, exact, rows
from scalargraph.errors import InputError

CLOSES = 1e-3
"""Largest gap [m or rad] in a pose, written to a few digits, with which the loops of a file count as closed."""


def kind_of(read: Any, i: int) -> str:
    return read.mujoco.mjtEq(int(read.model.eq_type[i])).name.removeprefix("mjEQ_").lower()


def anchor_of(read: Any, body: int) -> np.ndarray:
    """Origin of the frame of a body's link, in the frame of the body: the anchor of its last joint."""
    count = int(read.model.body_jntnum[body])
    return np.array(read.model.jnt_pos[read.model.body_jntadr[body] + count - 1]) if count else np.zeros(3)


def couple_joints(read: Any, joints: list[Joint]) -> tuple[list[Joint], list[Coincide | Coupled]]:
    """The joints, where equalities let them follow other joints or fix them, and all other equalities."""
    model, coupled, loops = read.model, {joint.name: joint for joint in joints}, []
    for i in range(model.neq):
        if not model.eq_active0[i] or read.off("EQUALITY"):
            continue
        kind = kind_of(read, i)
        read.used[f"equality/{kind}"] += 1
        if kind != "joint":
            loops.append(_coincide(read, i, kind))
            continue
        one, other = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        constant, *slopes = (float(number) for number in model.eq_data[i, :5])
        name = read.names[one]
        start = float(model.qpos0[model.jnt_qposadr[one]])
        # MuJoCo's polynomial relates deviations from qpos0: q − q₀ = c₀ + c₁ (p − p₀) + …
        deviation = Polynomial([0.0 if other < 0 else -float(model.qpos0[model.jnt_qposadr[other]]), 1.0])
        polynomial = (start + Polynomial([constant, *(slopes if other >= 0 else ())])(deviation)).trim().coef
        if len(polynomial) > 2:
            numbers = tuple(float(number) for number in polynomial)
            loops.append(Coupled(read.name("EQUALITY", i), (name, read.names[other]), numbers))
            continue
        if coupled[name].follows is not None:
            raise InputError(f"joint {name!r} is in two equalities; keep one")
        offset, ratio = (*polynomial, 0.0)[:2]
        follows = Follows("" if other < 0 else read.names[other], float(ratio), float(offset))
        coupled[name] = coupled[name]._replace(follows=follows)
    return list(coupled.values()), loops


def _coincide(read: Any, i: int, kind: str) -> Coincide:
    """The loop that a connect or weld closes, with its points in the frames of the links."""
    model, ends = read.model, (int(read.model.eq_obj1id[i]), int(read.model.eq_obj2id[i]))
    data, turned = np.array(model.eq_data[i]), np.eye(3)
    if int(model.eq_objtype[i]) == int(read.mujoco.mjtObj.mjOBJ_SITE):
        bodies = [int(model.site_bodyid[site]) for site in ends]
        points = [np.array(model.site_pos[site]) for site in ends]
        first, second = (rotation_of(model.site_quat[site]) for site in ends)
        turned = first @ second.T
    else:
        bodies = list(ends)
        # For a weld, the point in the second body comes first.
        points = [data[:3], data[3:6]] if kind == "connect" else [data[3:6], data[:3]]
        turned = rotation_of(data[6:10]) if kind == "weld" else turned
    points = [point - anchor_of(read, body) for point, body in zip(points, bodies, strict=True)]
    links = tuple(read.bodies[body] for body in bodies)
    whole = kind == "weld" and data[10] > 0  # a weld without a torque scale constrains only a point
    return Coincide(read.name("EQUALITY", i), links, rows(points), rows(exact(turned)) if whole else None)


def assembly_of(read: Any, loops: list[Coincide | Coupled]) -> dict[str, Any] | None:
    """Positions of the joints in the first pose of the file, qpos0 or a keyframe, that closes the loops."""
    mujoco, model = read.mujoco, read.model
    if not loops:
        return None
    data = mujoco.MjData(model)
    for pose in (model.qpos0, *model.key_qpos):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        gaps = data.efc_pos[data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)]
        if np.abs(gaps).max(initial=0.0) < CLOSES:
            sizes = [{mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}.get(k, 1) for k in model.jnt_type]
            at = zip(read.names, model.jnt_qposadr, sizes, strict=True)
            return {
                name: pose[place : place + size].tolist() if size > 1 else float(pose[place])
                for name, place, size in at
                if size < 7
            }
    return None


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """The rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * hat + 2 * hat @ hat
