"""A robot that speaks ROS 2, as a robot of the bus: nothing of ROS runs here."""
