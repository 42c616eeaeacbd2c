"""A folder of recorded episodes, as LeRobot writes them, to a fitted arm: accuracy, intervals, and moved zeros.

The five motions of an SO-101 arm are cut into episodes of 300 rows and written in the layout of LeRobot v3: positions
and commands in degrees, the gripper in per cent, float32, stamps that start again with each episode.

Run `COVARIANT_DATA=... python benchmarks/episodes.py` from the repository's root: `write FOLDER` writes the data set
only, `halves` compares fits of two halves of the episodes.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

ROWS = 300
FPS = 50
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
COLUMNS = ("rotation", "pitch", "elbow", "wrist_pitch", "wrist_roll", "jaw")
MOTIONS = ("multisine", "slow_precision", "friction_gravity", "static_holding", "step_response")
JAW = -0.17453, 1.74533
"""Range of the jaw [rad], which is 0 to 100 per cent."""


def motions() -> list[tuple[NDArray, NDArray]]:
    """Positions and commands (T, 6) of the recorded motions, in the units of LeRobot."""
    found = []
    for name in MOTIONS:
        rows = np.genfromtxt(Path(os.environ["COVARIANT_DATA"]) / "so101" / f"{name}.csv", delimiter=",", names=True)
        both = [np.stack([rows[f"{kind}_{column}"] for column in COLUMNS], axis=1) for kind in ("q", "cmd")]
        for each in both:
            each[:, :5] = np.degrees(each[:, :5])
            each[:, 5] = 100 * (each[:, 5] - JAW[0]) / (JAW[1] - JAW[0])
        found.append((both[0], both[1]))
    return found


def episodes() -> list[tuple[NDArray, NDArray]]:
    """Positions and commands of episodes of 300 rows, of all motions in turn."""
    cut = [[(q[k : k + ROWS], u[k : k + ROWS]) for k in range(0, len(q) - ROWS + 1, ROWS)] for q, u in motions()]
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
