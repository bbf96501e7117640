"""A car of ROS 2, by rclpy: odometry at 50 Hz, a policy that heads straight on, a driver that stops without commands.

Runs in the container of ``Dockerfile`` next to it; nothing of safedpa is there. At its end, after SECONDS (20), it says
in one line of JSON how many commands came, how many diagnostics, and how far it drove.
"""

from __future__ import annotations

import json
import math
import os
import time

import rclpy
from ackermann_msgs.msg import AckermannDriveStamped
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.node import Node

PERIOD = 0.02
PATIENCE = 0.25
WHEELBASE = 0.32


class Robot(Node):
    """Driver, odometry and policy in one node."""

    def __init__(self) -> None:
        super().__init__("robot")
        self.x, self.y, self.yaw, self.speed = -2.0, 0.0, 0.0, 0.0
        self.command, self.heard = (0.0, 0.0), -math.inf
        self.counts = {"commands": 0, "diagnostics": 0, "periods_without_a_command": 0}
        self.notice: list[str] = []
        self.odometry = self.create_publisher(Odometry, "/odom", 10)
        self.policy = self.create_publisher(AckermannDriveStamped, "/drive_in", 10)
        self.create_subscription(AckermannDriveStamped, "/drive", self.drive, 10)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.diagnose, 10)
        self.create_timer(PERIOD, self.turn)

    def drive(self, message: AckermannDriveStamped) -> None:
        """A command."""
        self.command, self.heard = (message.drive.speed, message.drive.steering_angle), time.monotonic()
        self.counts["commands"] += 1

    def diagnose(self, message: DiagnosticArray) -> None:
        """What gateway and filter say."""
        self.counts["diagnostics"] += 1
        for status in message.status:
            if status.message not in self.notice[-1:]:
                self.notice.append(status.message)

    def turn(self) -> None:
        """One period."""
        speed, steer = self.command
        if time.monotonic() - self.heard > PATIENCE:
            speed, steer = 0.0, 0.0
            self.counts["periods_without_a_command"] += 1
        self.speed += PERIOD * max(-4.5, min(4.5, 5.0 * (speed - self.speed)))
        self.x += PERIOD * self.speed * math.cos(self.yaw)
        self.y += PERIOD * self.speed * math.sin(self.yaw)
        self.yaw += PERIOD * self.speed * math.tan(steer) / WHEELBASE
        odometry = Odometry()
        odometry.header.stamp, odometry.header.frame_id = self.get_clock().now().to_msg(), "odom"
        odometry.child_frame_id = "base_link"
        place, turned = odometry.pose.pose.position, odometry.pose.pose.orientation
        place.x, place.y = self.x, self.y
        turned.z, turned.w = math.sin(self.yaw / 2), math.cos(self.yaw / 2)
        odometry.twist.twist.linear.x = self.speed
        self.odometry.publish(odometry)
        nominal = AckermannDriveStamped()
        nominal.header = odometry.header
        nominal.drive.speed = 1.5
        self.policy.publish(nominal)


def main() -> None:
    """Until its seconds are over."""
    rclpy.init()
    robot = Robot()
    end = time.monotonic() + float(os.environ.get("SECONDS_TO_DRIVE", "20"))
    while time.monotonic() < end:
        rclpy.spin_once(robot, timeout_sec=0.1)
    print(json.dumps({**robot.counts, "x": robot.x, "y": robot.y, "speed": robot.speed, "notice": robot.notice[-8:]}))  # noqa: T201


if __name__ == "__main__":
    main()
