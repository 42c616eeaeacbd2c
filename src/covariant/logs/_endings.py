"""Lists the file-name suffixes of logs that can be written, without loading the code that writes them."""

MESSAGES = (".mcap", ".rosbag2")
"""Suffixes of the logs of ROS messages that can be written."""
WRITTEN = (".csv", ".txt", ".tsv", ".parquet", *MESSAGES)
"""Suffixes of all logs that can be written."""
