"""The web page that Prometheus reads, and the heartbeat of the process that serves it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

from safedpa.bus import HEALTH, NO_ROBOT, HealthMessage
from safedpa.bus.overview import FleetOverview
from safedpa.bus.wire.version import software_version
from safedpa.errors import InputError
from safedpa_services.metrics.collector import FleetCollector

__all__ = ["Exporter"]

_TURN_SECONDS = 0.25


class Exporter:
    """Serves ``http://ADDRESS:PORT/metrics`` from now on; ``port`` is the one that it got."""

    def __init__(self, fleet: FleetOverview, address: str, port: int) -> None:
        from prometheus_client import CollectorRegistry, start_http_server

        self._fleet = fleet
        self._collector = FleetCollector(fleet)
        registry = CollectorRegistry()
        registry.register(self._collector)
        try:
            self._server, self._thread = start_http_server(port, address, registry)
        except (OSError, OverflowError) as error:
            raise InputError(
                f"--port {port}, --bind {address}: cannot listen there ({error}); choose others"
            ) from error
        self.port = int(self._server.server_port)
        self._turns = 0

    def run(self, stopped: Callable[[], bool]) -> None:
        """Listens to the fleet and serves until ``stopped``."""
        try:
            while not stopped():
                self.turn()
        finally:
            self._server.shutdown()
            self._server.server_close()

    def turn(self) -> None:
        """Takes in a quarter of a second of what is said, and tells the own health."""
        self._collector.listen(_TURN_SECONDS)
        self._turns += 1
        message = HealthMessage(
            epoch=0,
            tick=0,
            robot_time=0.0,
            publish_time=time.time(),
            service="metrics",
            pid=os.getpid(),
            state="running",
            detail=f"port {self.port}",
            steps=self._turns,
            refused=self._fleet.refused,
            software=software_version(),
        )
        self._fleet.bus.publish(HEALTH, NO_ROBOT, message, "metrics")
