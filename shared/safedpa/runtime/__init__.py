"""The filter of one robot on the bus: its scene, its session and its node.

Read ``robot_session`` first: it knows the past of a robot and asks the filter. ``node`` serves many robots.
"""
