"""The side of a robot that speaks ROS 2, by another implementation of the wire: car, policy, router, intruder.

What runs as a process here imports nothing of this project but the simulator.
"""
