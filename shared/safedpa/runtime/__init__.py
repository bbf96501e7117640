"""The safety filter as a service: one session per robot, and the node that serves them.

``robot_session`` holds the state of one robot between ticks and calls the filter; ``scene`` builds the barriers around
a robot; ``calibrated_model`` checks offered models and margins; ``stop_orders`` keeps stop orders on disk; ``node``
connects all of it to the bus. Read ``robot_session.py`` first, then ``node.py``.
"""
