"""What ROS says on the wire, without ROS: message types, their encodings, the keys of its Zenoh middleware."""

from safedpa.ros.decoding import Decoder
from safedpa.ros.definitions import Definitions, numeric_fields

__all__ = ["Decoder", "Definitions", "numeric_fields"]
