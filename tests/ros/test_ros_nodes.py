"""The node of an export under real ROS 2 (`make ros`): equal to the batch run on the recorded bag, faults survived."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

import covariant

ROOT = Path(__file__).parents[2]
ROS = ROOT / ".venv-ros"
START = 1_700_000_000_123_456_789
RATE, GAINS = 500.0, {"alpha": 60.0, "beta": 1800.0}
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not (ROS / "lib" / "librcl.so").exists(), reason="needs ROS 2 in .venv-ros: make ros"),
]


def bag(path, messages):
    """A rosbag2 of joint states (stamp, names, positions, efforts)."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types, kind = store.types, "sensor_msgs/msg/JointState"
    with Writer(path, version=9) as writer:
        connection = writer.add_connection("/joint_states", kind, typestore=store)
        for ns, names, position, effort in messages:
            header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(ns, 10**9)), "")
            message = types[kind](header, names, np.array(position), np.zeros(0), np.array(effort))
            writer.write(connection, ns, store.serialize_cdr(message, kind))
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    text = (ROOT / "examples" / "demo_double_pendulum.toml").read_text()
    path = tmp_path_factory.mktemp("model") / "arm.toml"
    path.write_text(text.replace('u = ["tau1", "tau2"]', 'u = ["q1/effort", "q2/effort"]'))
    return path


@pytest.fixture(scope="module")
def messages(model):
    """Joint states at 500 Hz: names in changing order, one in ten lost, two holes, a joint missing at times."""
    log = covariant.simulate(
        model, duration=6.0, rate=RATE, amplitude=[0.4, 0.2], quantum=1.5339807878856412e-3, seed=1
    )
    columns, random = log.columns, np.random.default_rng(2)
    made = []
    for k in range(len(columns["t"])):
        if k and (random.random() < 0.1 or 900 < k < 930 or 1500 < k < 1560):
            continue
        names = ["q1", "q2"] if random.random() < 0.5 or not k else ["q2", "gripper", "q1"]
        values = {"q1": 0, "q2": 1}
        position = [float(columns[n][k]) if n in values else 0.3 for n in names]
        effort = [float(columns[f"{n}/effort"][k]) if n in values else 0.0 for n in names]
        if k and random.random() < 0.02 and names[0] == "q2":
            names, position, effort = names[1:], position[1:], effort[1:]
        made.append((START + 2_000_000 * k, names, position, effort))
    return made


@pytest.fixture(scope="module")
def exported(model, messages, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ros")
    log = bag(folder / "whole", messages)
    covariant.export(model, folder / "out", rate=RATE, name="arm", ros2=True, log=log, **GAINS)
    return folder / "out" / "ros2"


@pytest.fixture(scope="module")
def node(exported, tmp_path_factory):
    """How the node is started, from its installed package."""
    place = tmp_path_factory.mktemp("nodes") / "site"
    pip = [ROS / "bin" / "python", "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", place, exported / "arm_ros"], check=True, timeout=120)
    start = f"import sys; sys.path.insert(0, {str(place)!r}); from arm_ros.node import main; main()"
    return [ROS / "bin" / "python", "-c", start]


def drive(command, plan, folder):
    (folder / "plan.json").write_text(json.dumps(plan))
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "LD_PRELOAD")}
    environment |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(os.getpid() % 100)}
    script = [ROS / "bin" / "python", Path(__file__).with_name("drive.py"), "plan.json", "out.json"]
    subprocess.run([*map(str, script + command)], cwd=folder, env=environment, check=True, timeout=120)
    return json.loads((folder / "out.json").read_text())


def batch(model, messages, folder):
    """The estimates of `covariant estimate` on the recorded bag, a row for each message."""
    result = covariant.estimate(model, bag(folder, messages), **GAINS)
    return np.column_stack([result.columns[name] for name in ("q1", "q2", "v1", "v2")])


def test_the_node_equals_the_batch_run_through_faults(node, model, messages, tmp_path):
    third = len(messages) // 3
    first, second, last = messages[:third], messages[third : 2 * third], messages[2 * third :]
    # Late ones and repeated ones between good ones; then the clock is set back by an hour, and the node restarted.
    faulty = [m for k, m in enumerate(first) for m in ([m, first[k - 1], m] if k % 50 == 49 else [m])]
    hour = 3600 * 10**9
    back = [(ns - hour, *rest) for ns, *rest in second]
    plan = [
        {"rate": RATE, "messages": faulty},
        {"rate": RATE, "messages": back},
        {"restart": True},
        {"rate": RATE, "messages": last},
    ]
    seen = drive(node, plan, tmp_path)
    rows = {ns: [*q, *v] for ns, _, q, v, _ in seen["heard"]}
    used = [first, back[4:], last]  # the first four after the clock was set back count as late
    worst = 0.0
    for k, part in enumerate(used):
        part = part[next(i for i, m in enumerate(part) if {"q1", "q2"} <= set(m[1])) :]
        got = np.array([rows[m[0]] for m in part])
        worst = max(worst, np.abs(got - batch(model, part, tmp_path / f"bag{k}")).max())
    latency = np.array(seen["latency_ns"]) * 1e-6
    sent = sum(map(len, (faulty, back, last)))
    took = sum(seen["took"])
    print(
        f"\n{sent} sent at {sent / took:.0f} Hz, {len(seen['heard'])} estimates of {sum(map(len, used))}; "
        f"largest difference to the batch run {worst:.1e}; there and back in {np.median(latency):.2f} ms in the "
        f"median, {np.percentile(latency, 99):.2f} ms in 99 of 100, {latency[-1]:.1f} ms at most"
    )
    print(seen["counts"][-1])
    assert all(names == ["q1", "q2"] for _, names, *_ in seen["heard"])
    assert worst < 1e-9
    before = [c for c in seen["counts"] if int(c["restarts"]) == 1][-1]
    assert int(before["repeated"]) + int(before["late"]) >= 2 * (len(first) // 50)


def test_numbers_of_the_model_change_at_run_time(node, messages, tmp_path):
    part = messages[:200]
    plan = [
        {"set": {"model.mass_2": 0.6, "model.coulomb_1": 0.0}},
        {"set": {"model.mass_2": 1e9}},
        {"rate": RATE, "messages": part},
    ]
    seen = drive(node, plan, tmp_path)
    assert [ok for ok, _ in seen["answers"]] == [True, True, False]
    assert "range" in seen["answers"][2][1]
    rows = {ns: v for ns, _, _, v, _ in seen["heard"]}
    plain = {ns: v for ns, _, _, v, _ in drive(node, plan[2:], tmp_path)["heard"]}
    assert max(abs(a - b) for ns, v in plain.items() for a, b in zip(v, rows[ns], strict=True)) > 1e-6


def test_the_clock_of_ros_that_goes_back_starts_the_estimate_anew_at_once(node, messages, tmp_path):
    part = [m for m in messages if {"q1", "q2"} <= set(m[1])][:50]
    early = [(ns - 10**10, *rest) for ns, *rest in part]
    plan = [
        {"clock": [START, START + 10**9]},
        {"rate": RATE, "messages": part},
        {"clock": [START - 10**10]},
        {"rate": RATE, "messages": early},
        {"clock": [START - 10**10 + k * 10**9 for k in (1, 2, 3)]},
    ]
    seen = drive([*node, "--ros-args", "-p", "use_sim_time:=true"], plan, tmp_path)
    assert len(seen["heard"]) == 100, "no message of those after the jump counts as late"
    assert (seen["counts"][-1]["restarts"], seen["counts"][-1]["late"]) == ("1", "0")
