"""Readers of logs of topics: rosbag2 (MCAP, SQLite, folder), ROS 1 bags and PX4 flight logs.

Read ``topics`` first: it defines a log. ``timeline`` places its messages in time, and ``join`` joins its topics to one
table. ``messages`` decodes ROS messages for the readers of bags, ``rosbag1`` and ``rosbag2``; ``ulog`` reads flight
logs; ``detect`` finds the reader of a file.
"""

from safedpa.records.readers.bags.detect import kind_of, topic_log
from safedpa.records.readers.bags.join import read_log_table
from safedpa.records.readers.bags.rosbag2 import check_readable_mcap
from safedpa.records.readers.bags.topics import AbstractLog, LoggedTopic, Series

__all__ = ["AbstractLog", "LoggedTopic", "Series", "check_readable_mcap", "kind_of", "read_log_table", "topic_log"]
