"""Feed a node with joint states under ROS 2 and record what comes back; run by the Python of an environment with rclpy.

Usage: drive.py PLAN.json OUT.json COMMAND…, the command that starts the node.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

plan, out, *command = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2]), *sys.argv[3:]
rclpy.init()
node = rclpy.create_node("driver")
executor = SingleThreadedExecutor()
executor.add_node(node)
sender = node.create_publisher(JointState, "joint_states", QoSProfile(depth=5000))
time_of_ros = node.create_publisher(Clock, "/clock", 10)
heard, sent, counts, taken = [], {}, [], {}


def hear(message):
    ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    taken[ns] = time.monotonic_ns() - sent.get(ns, 0)
    heard.append([ns, list(message.name), list(message.position), list(message.velocity), list(message.effort)])


def count(message):
    counts.append({v.key: v.value for v in message.status[0].values} | {"level": message.status[0].level[0]})


node.create_subscription(JointState, "joint_states_estimated", hear, QoSProfile(depth=5000))
node.create_subscription(DiagnosticArray, "/diagnostics", count, 10)


def spin(seconds):
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        executor.spin_once(timeout_sec=left)


def start():
    process = subprocess.Popen(command)
    while sender.get_subscription_count() == 0 or node.count_publishers("joint_states_estimated") == 0:
        spin(0.05)
        if process.poll() is not None:
            raise SystemExit("the node ended")
    spin(1.0)  # both ends of each topic know of each other
    return process


def stop(process):
    process.send_signal(signal.SIGINT)
    process.wait(10)
    while sender.get_subscription_count():
        spin(0.05)


def set_numbers(values):
    client = node.create_client(SetParameters, "/arm_observer/set_parameters")
    client.wait_for_service(timeout_sec=10.0)
    parameters = [
        Parameter(name=n, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=v))
        for n, v in values.items()
    ]
    future = client.call_async(SetParameters.Request(parameters=parameters))
    executor.spin_until_future_complete(future, timeout_sec=10.0)
    return [[result.successful, result.reason] for result in future.result().results]


process, answers = start(), []
for item in plan:
    if "restart" in item:
        spin(0.5)
        stop(process)
        process = start()
    elif "set" in item:
        spin(0.5)
        answers += set_numbers(item["set"])
    elif "clock" in item:
        for ns in item["clock"]:
            spin(0.5)
            time_of_ros.publish(Clock(clock=Time(sec=ns // 10**9, nanosec=ns % 10**9)))
        spin(0.5)
    else:
        begin = time.monotonic()
        for k, (ns, names, position, effort) in enumerate(item["messages"]):
            spin(begin + k / item["rate"] - time.monotonic())
            message = JointState(name=names, position=position, effort=effort)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(ns, 10**9)
            sent[ns] = time.monotonic_ns()
            sender.publish(message)
        item["took"] = time.monotonic() - begin
spin(2.5)
latency = sorted(taken.values())
peak = Path(f"/proc/{process.pid}/status").read_text() if os.path.exists("/proc") else ""
stop(process)
result = {"heard": heard, "counts": counts, "answers": answers, "latency_ns": latency, "status": peak}
out.write_text(json.dumps(result | {"took": [item["took"] for item in plan if "took" in item]}))
os._exit(0)
