"""The car for other software: ROS and Gazebo."""
