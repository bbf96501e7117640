"""Reads and writes ROS messages without a ROS installation.

Read ``definitions`` first (message types), then ``decoding`` (fast reading of selected fields) and ``encoding``.
``graph`` has the keys of ROS 2 on Zenoh, ``link`` a session with a robot, ``face`` the interface of a robot to ROS, and
``outgoing`` the messages that are published.
"""

from safedpa.ros.decoding import Decoder
from safedpa.ros.definitions import Definitions, numeric_fields

__all__ = ["Decoder", "Definitions", "numeric_fields"]
