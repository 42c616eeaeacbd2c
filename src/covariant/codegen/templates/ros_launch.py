"""Launch of the node: `ros2 launch xPACKAGEx xNAMEx.launch.py`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """The node with its configuration, under simulated time if asked."""
    config = Path(get_package_share_directory("xPACKAGEx")) / "config" / "xNAMEx.yaml"
    settings = [str(config), {"use_sim_time": LaunchConfiguration("use_sim_time")}]
    return LaunchDescription(
        [
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            Node(package="xPACKAGEx", executable="observer", parameters=settings, output="screen"),
        ]
    )
