"""Compare the dynamics of robots with Pinocchio and MuJoCo: the shipped ones and random trees, at random states.

    python tools/compare_robots.py --pinocchio PYTHON

PYTHON is an interpreter that has the package `pin`, which needs another version of NumPy than this one may have;
without it, MuJoCo alone is compared with. Prints the largest difference of inertia matrix, bias forces, weight and
forward dynamics, each relative to its size, and exits with 1 where one exceeds 1e-9.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

TOLERANCE = 1e-9
PINOCCHIO = """
import json, sys
import numpy as np, pinocchio as pin
path, states, out = sys.argv[1:]
# It has no ball joints in URDF: those are floating ones here, whose places stay at 0.
text = open(path, encoding="utf-8").read().replace('type="spherical"', 'type="floating"')
model = pin.buildModelFromXML(text)
data, given = model.createData(), np.load(states)
names, rows = json.loads(str(given["names"])), {k: [] for k in ("matrix", "bias", "weight", "rate")}
loose = int(given["floating"])
joints = [model.joints[model.getJointId(n)] for n in names]
turning = [range(j.idx_v + 3, j.idx_v + 6) if j.nv == 6 else [j.idx_v] for j in joints]
place = np.array([*range(6)] * loose + [i for each in turning for i in each], int)
for pose, turns, angles, v, force in zip(*(given[k] for k in ("pose", "turns", "angles", "v", "force"))):
    q = pin.neutral(model)
    if loose:
        q[:3], q[3:7] = pose[:3, 3], pin.Quaternion(pose[:3, :3]).coeffs()
    for j, turn, angle in zip(joints, turns, angles):
        if j.nv == 6:
            q[j.idx_q + 3 : j.idx_q + 7] = pin.Quaternion(turn).coeffs()
        else:
            q[j.idx_q : j.idx_q + j.nq] = angle if j.nq == 1 else [np.cos(angle), np.sin(angle)]
    w, u = np.zeros(model.nv), np.zeros(model.nv)
    w[place], u[place] = v, force
    m = pin.crba(model, data, q)
    m = np.triu(m) + np.triu(m, 1).T
    rows["matrix"].append(m[np.ix_(place, place)])
    rows["bias"].append(pin.nonLinearEffects(model, data, q, w)[place])
    rows["weight"].append(pin.computeGeneralizedGravity(model, data, q)[place])
    if len(place) == model.nv:
        rows["rate"].append(pin.aba(model, data, q, w, u)[place])
np.savez(out, **rows)
"""


def tree(seed: int) -> str:
    """A random tree as URDF: branches, joints of all kinds, some that follow, some trees that float."""
    rng = np.random.default_rng(seed)
    n, floating = int(rng.integers(2, 31)), seed % 3 == 0

    def numbers(values) -> str:
        return " ".join(f"{value:.6f}" for value in values)

    def link(name: str) -> str:
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        sides = rng.uniform(0.05, 0.3, 3) ** 2
        mass = rng.uniform(0.2, 5)
        tensor = turn @ np.diag(mass / 12 * (sides.sum() - sides)) @ turn.T
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        moments = " ".join(f'{k}="{v:.9f}"' for k, v in zip(keys, tensor[np.triu_indices(3)], strict=True))
        at = f'<origin xyz="{numbers(rng.uniform(-0.1, 0.1, 3))}" rpy="{numbers(rng.uniform(-1, 1, 3))}"/>'
        return f'<link name="{name}"><inertial>{at}<mass value="{mass:.6f}"/><inertia {moments}/></inertial></link>'

    rows, led = ['<link name="world"/>', link("l0")], None
    kind = "floating" if floating else "fixed"
    rows.append(f'<joint name="base" type="{kind}"><parent link="world"/><child link="l0"/></joint>')
    for i in range(1, n + 1):
        kinds = ["revolute", "continuous", "prismatic", "fixed", "spherical"]
        kind = str(rng.choice(kinds, p=[0.4, 0.18, 0.22, 0.1, 0.1]))
        parent = int(rng.integers(max(0, i - 4), i))
        rows.append(link(f"l{i}"))
        quarter = rng.integers(-1, 3, 3) * np.pi / 2 if rng.random() < 0.5 else rng.uniform(-2, 2, 3)
        axis = np.eye(3)[rng.integers(3)] if rng.random() < 0.5 else rng.normal(size=3)
        mimic, limit = "", '<limit lower="-9" upper="9" effort="1" velocity="1"/>' * (kind != "spherical")
        if kind == "revolute" and led and rng.random() < 0.25:
            mimic = f'<mimic joint="{led}" multiplier="{rng.uniform(-2, 2):.4f}" offset="{rng.uniform(-1, 1):.4f}"/>'
        elif kind not in ("fixed", "spherical"):
            led = f"j{i}"
        rows.append(
            f'<joint name="j{i}" type="{kind}"><parent link="l{parent}"/><child link="l{i}"/>'
            f'<origin xyz="{numbers(rng.uniform(-0.3, 0.3, 3))}" rpy="{" ".join(repr(float(a)) for a in quarter)}"/>'
            f'<axis xyz="{numbers(axis)}"/>{limit}{mimic}</joint>'
        )
    return f'<robot name="tree{seed}">' + "\n".join(rows) + "</robot>"


def plain(text: str) -> str:
    """Without friction, of which the engines have other models, and with planar joints as three of one axis."""
    text = re.sub(r"<dynamics[^>]*>", "", text)
    planar = re.search(r'<joint name="base" type="planar">.*?</joint>', text, re.DOTALL)
    if planar is None:
        return text
    chain, joints = ["ground", "base1", "base2", "torso"], []
    motions = (("x", "prismatic", "1 0 0"), ("y", "prismatic", "0 0 -1"), ("turn", "continuous", "0 1 0"))
    for (name, kind, axis), one, other in zip(motions, chain[:-1], chain[1:], strict=True):
        joints.append(
            f'<joint name="base_{name}" type="{kind}"><parent link="{one}"/><child link="{other}"/>'
            f'<axis xyz="{axis}"/><limit lower="-9" upper="9" effort="1" velocity="1"/></joint>'
        )
    moments = 'ixx="1e-6" ixy="0" ixz="0" iyy="1e-6" iyz="0" izz="1e-6"'
    small = f'<inertial><mass value="1e-3"/><inertia {moments}/></inertial>'  # MuJoCo needs some
    links = "".join(f'<link name="{name}">{small}</link>' for name in chain[1:3])
    return text.replace(planar[0], links + "".join(joints))


def states(model, joints: list, count: int, seed: int = 0) -> dict:
    """Random configurations and velocities of a robot with these moving joints.

    As they are here, and for the engines: pose of the base, and of each joint its angle, or its rotation where it is
    a ball; `whole` takes velocities here to those of the engines.
    """
    import jax.numpy as jnp

    from covariant.geometry.lie import SE3, SO3

    rng, tree, loose = np.random.default_rng(seed), model.space.tree, model.space.floating
    n, balls = len(model.coordinates), len(tree.balls)
    q = rng.uniform(-2, 2, (count, n))
    pose = [np.asarray(SE3.exp(jnp.asarray(s))) for s in rng.normal(size=(count, 6))] if loose else []
    spins = rng.normal(size=(count, balls, 3))
    turned = np.array([SO3.exp(jnp.asarray(s)) for s in spins.reshape(-1, 3)]).reshape(count, balls, 3, 3)
    parts = [np.reshape(part, (count, -1)) for part in (pose, turned, q) if np.size(part)]
    v, u = rng.normal(size=(2, count, 6 * loose + 3 * balls + n))
    u[:, : 6 * loose] = 0  # nothing drives a base
    spread = np.asarray(tree.coordinates)
    within = np.zeros((6 * loose, spread.shape[1]))
    whole = np.block([[np.eye(6 * loose), within], [np.zeros((len(spread), 6 * loose)), spread]])
    angles = q @ spread[:, 3 * balls :].T + np.asarray(tree.offset)
    first = np.cumsum([0] + [3 if joint.kind == "ball" else 1 for joint in joints])[:-1]
    turns = np.tile(np.eye(3), (count, len(joints), 1, 1))
    turns[:, [joint.kind == "ball" for joint in joints]] = turned
    return {
        "q": np.concatenate(parts, axis=1).reshape(count, *model.manifold.shape),
        "v": v,
        "u": u,
        "angles": angles[:, first],
        "turns": turns,
        "pose": np.array(pose) if loose else np.zeros((count, 4, 4)),
        "whole": whole,
        "names": [joint.name for joint in joints],
        "floating": loose,
    }


def ours(model, at: dict) -> dict:
    """Inertia matrix, bias forces, weight and forward dynamics of this library."""
    import jax
    import jax.numpy as jnp

    from covariant.geometry import differential
    from covariant.models import acceleration

    def all_of(q, v, u):
        weight = differential(model.manifold, model.potential, q)
        rate = acceleration(model, jnp.zeros(()), q, v, u)
        return {
            "matrix": model.space(q),
            "bias": model.space.connection_force(q, v, v) + weight,
            "weight": weight,
            "rate": rate,
        }

    found = jax.jit(jax.vmap(all_of))(*map(jnp.asarray, (at["q"], at["v"], at["u"][:, 6 * at["floating"] :])))
    return {name: np.asarray(part) for name, part in found.items()}


def coupled(theirs: dict, at: dict) -> dict:
    """What the engines say of joints that move freely, for joints that follow others or hold what an engine frees."""
    whole, matrix = at["whole"], np.array(theirs["matrix"])
    matrix = whole.T @ matrix @ whole
    bias, weight = (np.array(theirs[key]) @ whole for key in ("bias", "weight"))
    rate = np.linalg.solve(matrix, (at["u"] - bias)[..., None])[..., 0]
    if whole.shape[0] == whole.shape[1] and len(theirs["rate"]):  # the same joints, maybe in another order
        rate = np.array(theirs["rate"]) @ whole
    return {"matrix": matrix, "bias": bias, "weight": weight, "rate": rate}


def by_mujoco(text: str, at: dict) -> dict:
    """The same by MuJoCo, whose free joints have their linear velocity in the world."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(text)
    model.opt.gravity[:] = 0, 0, -9.81
    data = mujoco.MjData(model)
    joints = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in at["names"]]
    loose = 6 * at["floating"]
    balls = [model.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_BALL) for j in joints]
    turning = [range(d, d + 1 + 2 * b) for d, b in zip(model.jnt_dofadr[joints], balls, strict=True)]
    place = np.array([*range(loose), *(i for each in turning for i in each)], int)
    rows = {name: [] for name in ("matrix", "bias", "weight", "rate")}
    given = (at[key] for key in ("pose", "turns", "angles", "v", "u"))
    for pose, turns, angles, v, u in zip(*given, strict=True):
        world, moved = np.eye(len(place)), np.zeros(len(place))
        w = at["whole"] @ v
        if loose:
            data.qpos[:3] = pose[:3, 3]
            mujoco.mju_mat2Quat(data.qpos[3:7], pose[:3, :3].ravel())
            world[:3, :3] = pose[:3, :3]
            moved[:3] = pose[:3, :3] @ np.cross(w[3:6], w[:3])
        for ball, i, turn, angle in zip(balls, model.jnt_qposadr[joints], turns, angles, strict=True):
            if ball:
                mujoco.mju_mat2Quat(data.qpos[i : i + 4], turn.ravel())
            else:
                data.qpos[i] = angle
        data.qvel[place] = world @ w
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        full = full[np.ix_(place, place)]
        rows["matrix"].append(world.T @ full @ world)
        rows["bias"].append(world.T @ (data.qfrc_bias[place] + full @ moved))
        if len(w) == len(v):
            data.qfrc_applied[place] = world @ at["whole"] @ u
            mujoco.mj_forward(model, data)
            rows["rate"].append(world.T @ (data.qacc_smooth[place] - moved))
        data.qvel[:], data.qfrc_applied[:] = 0, 0
        mujoco.mj_forward(model, data)
        rows["weight"].append(world.T @ data.qfrc_bias[place])
    return coupled(rows, at)


def by_pinocchio(python: str, path: Path, at: dict) -> dict:
    """The same by Pinocchio, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder, "states.npz"), Path(folder, "found.npz")
        force = at["u"] @ np.linalg.pinv(at["whole"])
        np.savez(
            given,
            names=json.dumps(at["names"]),
            floating=at["floating"],
            pose=at["pose"],
            turns=at["turns"],
            angles=at["angles"],
            v=at["v"] @ at["whole"].T,
            force=force,
        )
        subprocess.run([python, "-c", PINOCCHIO, str(path), str(given), str(found)], check=True)
        return coupled(dict(np.load(found)), at)


def difference(mine: dict, theirs: dict) -> float:
    """The largest difference, each relative to the largest number of its kind."""
    return max(float(np.abs(mine[key] - theirs[key]).max() / (np.abs(theirs[key]).max() + 1e-9)) for key in mine)


def compared(text: str, count: int, python: str | None = None) -> dict[str, float]:
    """The largest difference to each engine for the robot of a URDF text."""
    from covariant.models import robots

    text = plain(text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "robot.urdf")
        path.write_text(text, encoding="utf-8")
        robot, model = robots.read(path), robots.load(path)
        moving = [joint for joint in robot.joints if joint.kind not in ("fixed", "floating")]
        at = states(model, moving, count)
        mine = ours(model, at)
        found = {"MuJoCo": difference(mine, by_mujoco(text, at))}
        if python:
            found["Pinocchio"] = difference(mine, by_pinocchio(python, path, at))
        return found


def main() -> int:
    """Compare all robots, a line each; the exit code."""
    from covariant.models import robots

    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pinocchio", help="a Python interpreter that has the package pin")
    parser.add_argument("--trees", type=int, default=30, help="number of random trees")
    parser.add_argument("--states", type=int, default=100, help="number of random states of each robot")
    given = parser.parse_args()
    files = {name: robots.located(name) for name in robots.ROBOTS}  # trees are URDF, closed loops MJCF
    texts = {name: path.read_text(encoding="utf-8") for name, path in files.items() if path.suffix == ".urdf"}
    texts |= {f"tree {seed}": tree(seed) for seed in range(given.trees)}
    worst = 0.0
    for name, text in texts.items():
        found = compared(text, given.states, given.pinocchio)
        worst = max(worst, *found.values())
        print(f"{name:<18}" + "  ".join(f"{engine} {value:.1e}" for engine, value in found.items()), flush=True)
    print(f"largest difference {worst:.1e}, allowed {TOLERANCE:.0e}")
    return int(worst > TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
