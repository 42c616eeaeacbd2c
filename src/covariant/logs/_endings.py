"""Endings of logs that can be written, available without loading what writes them."""

MESSAGES = (".mcap", ".rosbag2")
"""Endings of the logs of ROS messages that can be written."""
WRITTEN = (".csv", ".txt", ".tsv", ".parquet", *MESSAGES)
"""Endings of all logs that can be written."""
