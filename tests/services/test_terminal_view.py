"""The first line of the terminal's table, before the robot says anything and after."""

from __future__ import annotations

from safedpa.bus import Bus, MemoryBroker, MemoryTransport, StateMessage
from safedpa_services.supervisor.view import _headline
from safedpa_services.supervisor.watch import Watch


def test_until_the_robot_speaks_it_is_waited_for() -> None:
    watch = Watch(Bus(MemoryTransport(MemoryBroker()), "f"))
    assert _headline(watch).plain == "waiting for the robot"
    watch.state = StateMessage(
        epoch=1,
        tick=20,
        robot_time=1.0,
        publish_time=0.0,
        values=(1.0, 2.0, 0.0, -0.75),
        applied=(0.0, 0.0),
        applied_by="filter",
        period=0.05,
        lockstep=True,
        goal=(),
        obstacles=(),
        field=(),
        footprint=(),
        goals_reached=3,
        collisions=2,
    )
    assert _headline(watch).plain == "    1.0 s  -0.75 m/s  goals 3  collisions 2  "
