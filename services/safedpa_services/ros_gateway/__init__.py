"""The ROS gateway: connects a robot that uses ROS 2 to the bus. No ROS installation is needed here.

Read ``gateway.py`` first: its loop publishes states and sends the filter's actions to the robot's driver.
``__main__.py`` builds it from the robot's file (``robot_file.py``). ``sensor_inputs.py`` receives messages,
``publisher_monitor.py`` detects second publishers.
"""
