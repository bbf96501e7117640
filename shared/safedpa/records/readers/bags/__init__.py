"""Logs of topics, read as they are: rosbag2 in MCAP, SQLite or a folder, ROS 1 bags, PX4 flight logs."""

from safedpa.records.readers.bags.detect import kind_of, topic_log
from safedpa.records.readers.bags.topics import AbstractLog, LoggedTopic, Series, read_log_table

__all__ = ["AbstractLog", "LoggedTopic", "Series", "kind_of", "read_log_table", "topic_log"]
