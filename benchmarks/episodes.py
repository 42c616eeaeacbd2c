"""A folder of recorded episodes, as LeRobot writes them, to a fitted arm: accuracy, intervals, and moved zeros.

The five motions of an SO-101 arm are cut into episodes of 300 rows and written in the layout of LeRobot v3: positions
and commands in degrees, the gripper in per cent, float32, stamps that start again with each episode.

Run `COVARIANT_DATA=... python benchmarks/episodes.py` from the repository's root: it fits all episodes, two halves of
them, and predicts each whole motion by a fit to the others. `write FOLDER` writes the data set only, `arms 0 40` fits
simulated arms.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import servo_machines
from numpy.typing import NDArray

import covariant
from covariant import models
from covariant.calibration.identification import predict_servos
from covariant.signals import Record

ROWS = 300
FPS = 50
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
COLUMNS = ("rotation", "pitch", "elbow", "wrist_pitch", "wrist_roll", "jaw")
MOTIONS = ("multisine", "slow_precision", "friction_gravity", "static_holding", "step_response")
JAW = -0.17453, 1.74533
"""Range of the jaw [rad], which is 0 to 100 per cent."""


def recorded(name: str) -> Record:
    """A motion as it was recorded [rad], with the jaw."""
    rows = np.genfromtxt(Path(os.environ["COVARIANT_DATA"]) / "so101" / f"{name}.csv", delimiter=",", names=True)
    q, u = (np.stack([rows[f"{kind}_{column}"] for column in COLUMNS], axis=1) for kind in ("q", "cmd"))
    return Record(rows["t"], u, q)


def motions(names: Sequence[str]) -> list[tuple[NDArray, NDArray]]:
    """Positions and commands (T, 6) of recorded motions, in the units of LeRobot."""
    found = []
    for name in names:
        log = recorded(name)
        both = [np.asarray(log.y), np.asarray(log.u)]
        for each in both:
            each[:, :5] = np.degrees(each[:, :5])
            each[:, 5] = 100 * (each[:, 5] - JAW[0]) / (JAW[1] - JAW[0])
        found.append((both[0], both[1]))
    return found


def episodes(names: Sequence[str] = MOTIONS) -> list[tuple[NDArray, NDArray]]:
    """Positions and commands of episodes of 300 rows, of motions in turn."""
    cut = [[(q[k : k + ROWS], u[k : k + ROWS]) for k in range(0, len(q) - ROWS + 1, ROWS)] for q, u in motions(names)]
    most = max(map(len, cut))
    return [each[k] for k in range(most) for each in cut if k < len(each)]


def write(folder: Path, each: Sequence[tuple[NDArray, NDArray]], joints: Sequence[str], robot: str, fps: float) -> None:
    """Write a data set in the layout of LeRobot v3: all episodes in one file, a row group for each."""
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    (folder / "meta").mkdir()
    names = [f"{joint}.pos" for joint in joints]
    lists = {"dtype": "float32", "shape": [len(names)], "names": names}
    info = {
        "codebase_version": "v3.0",
        "robot_type": robot,
        "total_episodes": len(each),
        "total_frames": sum(len(q) for q, _ in each),
        "fps": fps,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {"action": lists, "observation.state": lists}
        | {name: {"dtype": "int64", "shape": [1]} for name in ("frame_index", "episode_index", "index", "task_index")}
        | {"timestamp": {"dtype": "float32", "shape": [1]}},
    }
    (folder / "meta" / "info.json").write_text(json.dumps(info, indent=4))
    writer, first = None, 0
    for k, (q, u) in enumerate(each):
        count = len(q)
        of_joints = pa.list_(pa.float32(), len(names))
        table = pa.table(
            {
                "action": pa.array(u.astype(np.float32).tolist(), of_joints),
                "observation.state": pa.array(q.astype(np.float32).tolist(), of_joints),
                "timestamp": pa.array((np.arange(count) / fps).astype(np.float32)),
                "frame_index": pa.array(np.arange(count)),
                "episode_index": pa.array(np.full(count, k)),
                "index": pa.array(first + np.arange(count)),
                "task_index": pa.array(np.zeros(count, int)),
            }
        )
        writer = writer or pq.ParquetWriter(data / "file-000.parquet", table.schema)
        writer.write_table(table)
        first += count
    assert writer is not None
    writer.close()


def fitted(folder: Path, model: Path) -> Any:
    """The arm drafted and fitted from a folder, without options; the model file is written."""
    first = folder.with_suffix(".toml")
    covariant.verbs.init(folder).save(first)
    result = covariant.fit(first, folder, progress=lambda *_: None)
    result.save(model)
    return result


def left_out(name: str, root: Path) -> NDArray:
    """Root mean square errors (5,) of a whole motion [rad], open loop, by a fit to episodes of the other motions."""
    folder, log = root / f"without_{name}", recorded(name)
    write(folder, episodes([each for each in MOTIONS if each != name]), JOINTS, "so101_follower", FPS)
    fitted(folder, root / f"{name}.toml")
    family = models.robot_family(str(root / f"{name}.toml"), ["servo"])
    y, u = np.asarray(log.y)[:, :5], np.asarray(log.u)[:, :5]
    q = predict_servos(family, np.zeros(len(family.names)), Record(log.t, u, y))
    return np.sqrt(np.mean((q - y) ** 2, axis=0))


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        root, each = Path(place), episodes()
        write(root / "all", each, JOINTS, "so101_follower", FPS)
        began = time.process_time()
        result = fitted(root / "all", root / "fitted.toml")
        print(f"{time.process_time() - began:.0f} s of a core")
        errors = 1e3 * np.array(result.summary["held_out_errors"]["after"]["position"])
        print("held-out episodes, open loop [mrad]:", ", ".join(f"{error:.1f}" for error in errors))
        halves = []
        for k in range(2):
            write(root / f"half{k}", each[k::2], JOINTS, "so101_follower", FPS)
            halves.append(fitted(root / f"half{k}", root / f"fitted{k}.toml"))
        a, b = halves
        known = np.isfinite(a.standard_errors) & np.isfinite(b.standard_errors)
        apart = np.abs(a.values - b.values) < 1.96 * (a.standard_errors + b.standard_errors)
        print(f"intervals of {known.sum()} numbers in both halves: {apart[known].sum()} overlap")
        for row in zip(a.columns["parameter"], a.values, a.standard_errors, b.values, b.standard_errors, strict=True):
            print("{:40s} {:9.4g} ± {:8.2g} {:9.4g} ± {:8.2g}".format(*row))
        for name in MOTIONS:
            errors = ", ".join(f"{1e3 * error:.1f}" for error in left_out(name, root))
            print(f"whole {name} by a fit to the other motions [mrad]: {errors}")


UNLIKE = dict.fromkeys(("viscous", "stribeck"), (0.0, 0.0))
"""Ranges of numbers that a draft does not have: damping and viscous friction act by their sum."""


def chain(n: int) -> servo_machines.Machine:
    """An arm of n joints about alternating axes, the first of them vertical."""
    text = '<robot name="chain"><link name="base"/>\n'
    for k in range(n):
        axis, length = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "0 0 1")[k], 0.14 - 0.015 * k
        mass, moment = 0.16 - 0.02 * k, 4e-4 / (k + 1)
        place = (0, 0, 0.05 if k == 0 else 0.155 - 0.015 * k)
        centre, moments = (0.01, 0.005, length / 2), (moment, moment, moment / 4)
        text += servo_machines._link(
            f"part{k}", "base" if k == 0 else f"part{k - 1}", place, axis, mass, centre, moments
        )
    names = tuple(f"part{k}_joint" for k in range(n))
    middle, size = np.resize([0.0, 0.6, 0.5, 0.0, 0.3, 0.0], n), np.resize([0.8, 0.5, 0.6, 0.7], n)
    return servo_machines.Machine(text + "</robot>", names, middle, size, (f"part{n - 1}", (0, 0, 0.05)), 5e-4)


def simulated(run: int, root: Path) -> str:
    """One arm with servos drawn at random and 24 episodes of 6 s; from one of them on, or in it, a zero is another."""
    rng = np.random.default_rng([76, run])
    n = 2 + run % 5
    machine, kind = chain(n), ("none", "from", "in")[run % 3]
    servo = servo_machines.draw_servo(machine, servo_machines.SO101 | {"delay": (0.005, 0.1), **UNLIKE}, rng)
    at, joint, size = (
        int(rng.integers(4, 20)),
        int(rng.integers(n)),
        float(rng.uniform(0.05, 0.3) * rng.choice([-1, 1])),
    )
    each = []
    for k in range(24):
        moved = (kind == "from" and k >= at) or (kind == "in" and k == at)
        own = servo._replace(offset=servo.offset + size * moved * (np.arange(n) == joint))
        t, command = servo_machines.commands(machine, 6.0, FPS, rng)
        log = servo_machines.simulate(machine, own, t, command)
        each.append((np.degrees(log.q), np.degrees(log.command)))
    write(root / "set", each, machine.joints, "chain", FPS)
    (root / "chain.urdf").write_text(machine.urdf, encoding="utf-8")
    covariant.verbs.init(root / "set", overrides={"parameters.path": str(root / "chain.urdf")}).save(root / "arm.toml")
    began = time.process_time()
    result = covariant.fit(root / "arm.toml", root / "set", progress=lambda *_: None)
    rows = [row for row in result.summary["parameters"] if row["determined"]]
    places = [(machine.joints.index(row["name"].split(".")[1]), row["name"].split(".")[2]) for row in rows]
    # After a change that is early the longer stretch has the other zero.
    late = size * (kind == "from" and at < 12)
    true = np.array([getattr(servo, key)[j] + late * (j == joint and key == "offset") for j, key in places])
    off = np.array([(row["after"] - x) / row["standard_error"] for row, x in zip(rows, true, strict=True)])
    zeros = [each for each in result.summary.get("changes", []) if "zero" in each]
    right = [each for each in zeros if f"{machine.joints[joint]} " in each and each.find(f"#{at}") > 0]
    said = "none" if not zeros else "right" if right and len(zeros) == 1 else f"wrong: {zeros}"
    errors = 1e3 * np.array(result.summary["held_out_errors"]["after"]["position"])
    return (
        f"{run}: {n} joints, {kind} {size:+.2f} at {at} of {joint}: {said}; {(abs(off) <= 4).sum()} of {len(off)} "
        f"numbers within 4 standard errors; {np.median(errors):.1f} mrad; {time.process_time() - began:.0f} s; "
        f"better {result.better} {result.summary['suspicion']}"
        + "".join(
            f"\n    {row['name']} {row['after']:.4g} ± {row['standard_error']:.2g}, true {x:.4g}"
            for row, z, x in zip(rows, off, true, strict=True)
            if abs(z) > 4
        )
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["arms"]:
        for run in range(*map(int, sys.argv[2:4])):
            with tempfile.TemporaryDirectory() as place:
                print(simulated(run, Path(place)), flush=True)
        sys.exit()
    if sys.argv[1:2] == ["write"]:
        write(Path(sys.argv[2]), episodes(), JOINTS, "so101_follower", FPS)
    else:
        main()
