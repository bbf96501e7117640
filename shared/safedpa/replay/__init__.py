"""Replays a bus recording through the real nodes, and compares their outputs with the recorded ones.

Read ``tape`` first (a sorted recording), then ``driver`` (runs one node through its recorded steps) and ``replay``
(compares all services). ``setups`` builds the nodes, ``what_if`` replays another filter, ``report`` writes results, and
``ros2_bag`` exports a recording to ROS 2.
"""
