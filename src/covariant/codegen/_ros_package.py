"""Packs an exported observer as a package of ROS 2: a node in Python around its module.

Sources: REP 149, package.xml; the messages of sensor_msgs and diagnostic_msgs.
"""

import json
import math
from collections.abc import Mapping
from xml.sax.saxutils import escape

import numpy as np

from covariant.codegen._program import Program
from covariant.codegen._python_package import python_files
from covariant.codegen._source import common_words
from scalargraph.errors import InputError
from scalargraph.template import Words, fill

LONGEST_GAP, SET_BACK = 1.0, 5
"""Gap [s] and number of late samples in a row after which the estimate restarts, as in `engine.Stream`."""
POSITIVE = ("mass", "inertia", "length", "alpha", "beta", "noise", "speed")
"""Numbers that stay above zero; their range is from a tenth to ten times the exported value."""
DEPENDS = ("rclpy", "sensor_msgs", "diagnostic_msgs", "rcl_interfaces", "launch_ros", "python3-numpy")
"""Packages that the node needs when it runs."""


def ros_files(program: Program, texts: Mapping[str, str], name: str, about: str, rate: float) -> dict[str, bytes]:
    """Build a package of ROS 2 around an exported observer of joints.

    Args:
        program: The observer as graphs.
        texts: Its header and source, as `export_texts` writes them.
        name: Prefix of all names in C, and name of the Python module.
        about: A line that describes the observer.
        rate: Sampling rate [Hz] for which it was made.

    Returns:
        Contents by their path in the folder of the export: `ros2/NAME_ros`, which pip and colcon build.

    Raises:
        ValueError: The observer needs measurements other than one position of each joint.
        OSError: The compiler refuses the sources.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))._replace(signals=codegen.Signals(("q1 [rad]",)))
        >>> source = codegen.write_source(program, "speed", "A filtered derivative.")
        >>> texts = {"speed.h": source.header, "speed.c": source.source}
        >>> files = codegen.ros_files(program, texts, "speed", "A filtered derivative.", 100.0)
        >>> "ros2/speed_ros/package.xml" in files
        True
    """
    if len(program.y) != 1 or program.sensors or [leaf.name for leaf in program.output][:2] != ["q", "v"]:
        raise InputError("--ros2 is for observers of joints, each with a position; this one reads something else")
    words = common_words(program, name, about) | _words(program, name, about, rate)
    package = f"{name.lower()}_ros"
    module = python_files(program, texts, name, about, rate)
    files = {path.removeprefix("python/"): data for path, data in module.items() if not path.endswith(".whl")}
    files |= {
        "package.xml": _manifest(package, about),
        "setup.py": fill("covariant.codegen", "ros_setup.py", words),
        "setup.cfg": f"[develop]\nscript_dir=$base/lib/{package}\n[install]\ninstall_scripts=$base/lib/{package}\n",
        f"resource/{package}": "",
        f"{package}/__init__.py": "",
        f"{package}/node.py": fill("covariant.codegen", "ros_node.py", words),
        f"launch/{name}.launch.py": fill("covariant.codegen", "ros_launch.py", words),
        f"config/{name}.yaml": fill("covariant.codegen", "ros_config.yaml", words),
    }
    written = {f"ros2/{package}/{path}": content for path, content in files.items()}
    return {path: text.encode() if isinstance(text, str) else text for path, text in written.items()}


def _words(program: Program, name: str, about: str, rate: float) -> Words:
    n, flat = program.measurements, {leaf.name: np.ravel(program.numbers[leaf.name]) for leaf in program.parameters}
    labels = program.signals.y if len(program.signals.y) == n else tuple(f"joint{k + 1}" for k in range(n))
    joints = [label.partition(" [")[0].removesuffix("/position").rpartition("/")[2] for label in labels]
    force = next((x.name for x in program.stored if x.name.endswith("force") and x.size == n), "")
    return {
        "PACKAGE": f"{name.lower()}_ros",
        "ABOUT": about.replace("\\", "/").replace('"', "'").replace("*/", ""),
        "JOINTS": json.dumps(joints),
        "FORCE": json.dumps(force),
        "RATE": repr(float(rate)),
        "LONGEST_GAP": LONGEST_GAP,
        "SET_BACK": SET_BACK,
        "USE_EFFORT": str(program.u == n).lower(),
        "RANGES": [
            f"    {key!r}: {[(*_range(key, value), program.units.get(key) or '') for value in values.tolist()]},"
            for key, values in flat.items()
        ],
    }


def _range(name: str, value: float) -> tuple[float, float]:
    """The range of values of a number of the model that may be set at run time."""
    if name.startswith(POSITIVE) and value > 0:
        return value / 10, value * 10
    reach = 10 * abs(value) if value and math.isfinite(value) else 10.0
    return (0.0 if name.startswith(("viscous", "coulomb")) and value >= 0 else -reach), reach


def _manifest(package: str, about: str) -> str:
    depends = [f"  <exec_depend>{each}</exec_depend>" for each in DEPENDS]
    words = {"PACKAGE": package, "DESCRIPTION": escape(about), "LICENSE": "Proprietary"}
    return fill("covariant.codegen", "ros_package.xml", words | {"DEPENDS": depends})
