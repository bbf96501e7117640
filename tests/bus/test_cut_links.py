"""Links are ended by the addresses of their far ends; what has none keeps none of the others alive."""

import time
from pathlib import Path

from safedpa.bus import ZenohSettings, ZenohTransport


def linked(transport: ZenohTransport, count: int) -> set[str]:
    """Zenoh ids of those who are linked, once there are so many."""
    end = time.monotonic() + 60.0
    while len(found := {session for session, _ in transport.members()}) < count and time.monotonic() < end:
        time.sleep(0.02)
    assert len(found) == count
    return found


def test_a_guest_from_the_network_is_cut_off_and_one_at_the_socket_of_this_user_is_not(free_port: int, tmp_path: Path):
    """A socket in a folder has a path and no port. Anyone who ends what is expired names both, and the one is ended."""
    doors = (f"tcp/127.0.0.1:{free_port}", f"unixsock-stream/{tmp_path}/bus")
    listening = ZenohTransport(ZenohSettings("router", doors))
    guests = []
    try:
        guests.append(ZenohTransport(ZenohSettings("client", connect=(doors[1],))))
        (at_the_socket,) = linked(listening, 1)
        assert listening.cut_off({at_the_socket}) == 0
        assert listening.cut_off({"no_one"}) == 0
        guests.append(ZenohTransport(ZenohSettings("client", connect=(doors[0],))))
        both = linked(listening, 2)
        assert listening.cut_off(both) == 1
        assert listening.name_of(at_the_socket) == "", "it shows no certificate, and is linked still"
        assert at_the_socket in {session for session, _ in listening.members()}
    finally:
        for transport in (*guests, listening):
            transport.close()
