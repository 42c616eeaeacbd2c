"""A node of ROS 2: joint states in, joint states with estimated velocities out.

xABOUTx

xSENTENCEx
"""

from __future__ import annotations

import math
import sys

import rclpy
import xNAMEx
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState

JOINTS = xJOINTSx
FORCE = xFORCEx
"""The estimate of a force in the state of the observer, "" where it estimates none."""
RANGES = {
    #: xRANGESx
}
"""Least and largest value, and unit, of each number of the model that may be changed at run time."""
LONGEST_GAP = xLONGEST_GAPx
"""Longest gap [s] between samples that the model predicts over; after a longer one the estimate starts anew."""
SET_BACK = xSET_BACKx
"""Number of samples in a row with earlier stamps than the last used one after which the clock counts as set back."""
COUNTS = ("samples", "accepted", "coasted", "refused", "late", "repeated", "restarts", "gaps", "incomplete", "lost")
SENSOR_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Two seconds at 500 Hz: a queue of ten loses messages while the process waits for a processor."""


class ObserverNode(Node):
    """Estimates of `joint_states`, as `joint_states_estimated`, with counts of faults as `/diagnostics`."""

    def __init__(self) -> None:
        super().__init__("xNAMEx_observer")
        self.joints = self._fixed("joints", JOINTS, "names of the joints, in the order of the model")
        self.effort = self._fixed("use_effort", bool(xNAMEx.INPUTS), "read the effort of a message as the input")
        period = self._fixed("diagnostics_period", 1.0, "time between diagnostics [s]", (0.01, 60.0))
        self.gap = self._fixed(
            "longest_gap", LONGEST_GAP, "gap [s] after which the estimate starts anew", (0.001, LONGEST_GAP)
        )
        if len(self.joints) != len(JOINTS):
            raise ValueError(f"joints has {len(self.joints)} names; the model has {len(JOINTS)}: {', '.join(JOINTS)}")
        self.observer = xNAMEx.Observer()
        self.numbers = {}  # array and place of each number of the model, by the name of its parameter
        for name, values in self.observer.params.items():
            for place, value in enumerate(values.ravel().tolist()):
                self._declare_number(name, place, values.size, value)
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._apply)
        self._apply(list(self._parameters.values()))
        self.counts = dict.fromkeys(COUNTS, 0)
        self.age = self.last_result = None
        self._restart()
        self.out = self.create_publisher(
            JointState,
            "joint_states_estimated",
            1000,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_subscription(
            JointState,
            "joint_states",
            self.take,
            SENSOR_QOS,
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._lose),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self.create_timer(period, self.report)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        self._jumps = self.get_clock().create_jump_callback(back, post_callback=self._jump)

    def take(self, message: JointState) -> None:
        """One sample: a stamp, positions by the names of their joints, and the efforts that act from this stamp on."""
        self.counts["samples"] += 1
        # Integers: seconds since 1970 in a float resolve a quarter of a microsecond only.
        now = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        place = {name: k for k, name in enumerate(message.name)}
        y = self._by_name(place, message.position)
        u = self._by_name(place, message.effort) if self.effort and message.effort else None
        if any(map(math.isnan, y)):
            self.counts["incomplete"] += 1
        dt = None if self.stamp is None else (now - self.stamp) * 1e-9
        if dt is not None and dt <= 0:
            self.counts["late" if dt < 0 else "repeated"] += 1
            self.back = self.back + 1 if dt < 0 else 0
            if self.back < SET_BACK:
                return
        if dt is not None and (dt > self.gap or dt < 0):
            self.counts["restarts"] += 1
            self._restart()
            dt = None
        self.back = 0
        if dt is not None and dt > 1.5 / xNAMEx.RATE:
            self.counts["gaps"] += 1
        acting = u if xNAMEx.INPUT_AT_END else self.acting
        result = self.observer.step(y, 0.0 if dt is None else dt, acting)
        self.stamp, self.acting = (now, u) if self.observer.started else (None, None)
        self._count(result)
        if self.observer.started:
            self.out.publish(self._estimate(message))
            self.age = (self.get_clock().now().nanoseconds - now) * 1e-9

    def report(self) -> None:
        """Publish the counts."""
        lost = self.counts["refused"] + self.counts["lost"] + self.counts["late"] + self.counts["restarts"]
        level = DiagnosticStatus.WARN if lost else DiagnosticStatus.OK
        if not self.observer.started:
            level = DiagnosticStatus.STALE
        text = "waiting for a complete message" if self.last_result is None else self.last_result.message
        values = [KeyValue(key=key, value=str(count)) for key, count in self.counts.items()]
        values.append(KeyValue(key="age of the last estimate [s]", value=f"{self.age:.6f}" if self.age else ""))
        status = DiagnosticStatus(level=level, name=self.get_name(), message=text, hardware_id="xNAMEx", values=values)
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(array)

    def _estimate(self, message: JointState) -> JointState:
        estimate = self.observer.estimate()
        told = JointState(header=message.header, name=self.joints)
        told.position, told.velocity = estimate.q.ravel().tolist(), estimate.v.ravel().tolist()
        if FORCE:
            told.effort = self.observer.state[FORCE].ravel().tolist()
        return told

    def _by_name(self, place: dict, values: object) -> list:
        """Numbers in the order of the model; NaN where a message has none."""
        return [values[place[name]] if place.get(name, len(values)) < len(values) else math.nan for name in self.joints]

    def _count(self, result: xNAMEx.Result) -> None:
        kind = {"OK": "accepted", "COASTED": "coasted", "OUTLIER": "refused", "STEP_REFUSED": "late"}.get(result.name)
        self.counts[kind or ("restarts" if result.name in ("RESTARTED", "NOT_FINITE") else "accepted")] += 1
        self.last_result = result

    def _restart(self) -> None:
        """Forget all samples, so that the next complete message starts the estimate."""
        self.observer.started = False
        self.stamp = self.acting = None
        self.back = 0

    def _jump(self, jump: object) -> None:
        """Start anew where the clock of ROS goes back, as when a bag is played again."""
        if self.observer.started:
            self.counts["restarts"] += 1
            self._restart()

    def _lose(self, event: object) -> None:
        self.counts["lost"] = event.total_count

    def _fixed(self, name: str, value: object, description: str, limits: tuple | None = None) -> object:
        ranges = [FloatingPointRange(from_value=limits[0], to_value=limits[1])] if limits else []
        details = ParameterDescriptor(description=description, read_only=True, floating_point_range=ranges)
        return self.declare_parameter(name, value, details).value

    def _declare_number(self, name: str, place: int, size: int, value: float) -> None:
        least, largest, unit = RANGES[name][place]
        which = f" of {place + 1} in {size}" if size > 1 else ""
        details = ParameterDescriptor(
            description=f"{name}{which}{f' [{unit}]' if unit else ''}",
            floating_point_range=[FloatingPointRange(from_value=least, to_value=largest)],
        )
        key = f"model.{name}_{place + 1}" if size > 1 else f"model.{name}"
        self.numbers[key] = self.observer.params[name].reshape(-1), place
        self.declare_parameter(key, value, details)

    def _check(self, parameters: list) -> SetParametersResult:
        bad = [p.name for p in parameters if p.name in self.numbers and not math.isfinite(p.value)]
        return SetParametersResult(successful=not bad, reason=f"{', '.join(bad)}: not finite" if bad else "")

    def _apply(self, parameters: list) -> None:
        """Take over changed numbers of the model, from the next sample on."""
        for parameter in parameters:
            if parameter.name in self.numbers:
                array, place = self.numbers[parameter.name]
                array[place] = parameter.value


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init(args=sys.argv)
    node = ObserverNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
