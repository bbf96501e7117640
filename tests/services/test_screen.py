"""What the user sees of a running loop: the view on a terminal, lines in a pipe, warnings."""

import io
import json
import socket
import sys
from itertools import pairwise
from types import SimpleNamespace

import pytest
from tests.messages import finding_of, health_of, state_of, verdict_of

from safedpa.bus import Bus, MemoryBroker, MemoryTransport
from safedpa_services.supervisor.log_warnings import LogWarnings
from safedpa_services.supervisor.run_monitor import RunMonitor
from safedpa_services.supervisor.screen import screen
from safedpa_services.supervisor.view import render_view
from safedpa_services.terminal import terminal

PAGE = "http://127.0.0.1:8080/live?token=t"


@pytest.fixture
def watch():
    return RunMonitor(Bus(MemoryTransport(MemoryBroker()), "fleet"))


def child_of(folder, code=None, *, heartbeat=True, restarts=0):
    """Returns a child with the attributes that the view reads."""
    log = folder / "policy.log"
    ended = {"exit_code": code, "restarts": restarts, "cause": "", "given_up": False}
    return SimpleNamespace(name="policy", pid=4711, heartbeat=heartbeat, log=log, rotate_log=lambda: None, **ended)


def drawn(watch, child):
    """Returns the lines of the view."""
    console = terminal(file=io.StringIO(), width=200)
    console.print(render_view(watch, [child], ["a hint"], ["a warning"]))
    return console.file.getvalue().splitlines()


# the view


@pytest.mark.parametrize(
    ("silent", "code", "heartbeat", "shown"),
    [
        (0.5, None, True, "running"),
        (1.2, None, True, "silent"),
        (5.0, None, True, "silent"),
        (5.0, None, False, "running"),
        (0.5, -9, True, "ended"),
        (None, None, True, "starting"),
    ],
)
def test_the_table_shows_whether_each_process_is_alive(watch, clock, silent, code, heartbeat, shown, tmp_path):
    """With four heartbeats per second, a second of silence is shown."""
    if silent is not None:
        watch.health["policy"] = (
            health_of("policy", steps=31, stale=5, refused=3, step_microseconds=42.0),
            clock.begin,
        )
        clock.now = silent
    child = child_of(tmp_path, code, heartbeat=heartbeat, restarts=2)
    (row,) = [line.split() for line in drawn(watch, child) if "policy" in line]
    assert row[1:3] == [shown, "4711"]
    counts = ["31", "5", "3", "42", "us", f"{silent:.1f}", "s", "2"] if silent is not None else ["2"]
    assert row[3:] == counts


def see(watch, clock, **messages):
    """Lets the monitor receive messages now."""
    for name, message in messages.items():
        setattr(watch, name, message)
        setattr(watch, "_".join([name, "at"]), clock())


def test_the_headline_waits_for_the_robot_and_then_shows_its_state(watch, clock, tmp_path):
    assert drawn(watch, child_of(tmp_path))[0] == "waiting for the robot"
    see(watch, clock, state=state_of(1.0, 2.0, 0.0, -0.75, robot_time=1.0, goals_reached=3, collisions=2))
    shown = "1.0 s  -0.75 m/s  goals 3  collisions 2  0.0 s old"
    assert drawn(watch, child_of(tmp_path))[0].rstrip() == f"No verdict yet; the robot brakes. Last:     {shown}"
    see(watch, clock, verdict=verdict_of("corrected", h_now=-0.256, margin=0.0304, microseconds=81.0))
    assert drawn(watch, child_of(tmp_path))[0].endswith("corrected h -0.26  margin 0.030  81 us  0.0 s old")
    see(watch, clock, state=state_of(0.5, 0.0, corridor=(0.1, 0.1)))
    assert "+28.6 degrees" in drawn(watch, child_of(tmp_path))[0]
    see(watch, clock, state=state_of(0.5, 0.0))
    assert "+0.50  goals" in drawn(watch, child_of(tmp_path))[0]


@pytest.mark.parametrize("silent", [1.0, 7.0, 300.0])
def test_the_headline_is_the_present_and_old_values_come_after_it_with_their_age(watch, clock, silent, tmp_path):
    see(watch, clock, state=state_of(), verdict=verdict_of("passed", stationary_reason="a wall", stationary_for=9.0))
    clock.now += silent
    (line, *others) = drawn(watch, child_of(tmp_path))
    assert line.startswith(f"No state for {silent:.0f} s; the robot has ended, hangs or is cut off, and brakes by")
    assert line.count("s old") == 2
    assert not any("stationary" in other for other in others), "no cause of a present stop is known"
    see(watch, clock, state=state_of())
    assert drawn(watch, child_of(tmp_path))[0].startswith(f"No verdict for {silent:.0f} s; the robot brakes. Last: ")


def test_the_reason_of_a_stop_and_a_finding_are_shown(watch, clock, tmp_path):
    see(watch, clock, verdict=verdict_of("corrected"))
    assert not [line for line in drawn(watch, child_of(tmp_path)) if "stands for" in line]
    stood = verdict_of("corrected", stationary_for=7.0, stationary_reason="the wall is near")
    see(watch, clock, verdict=stood, finding=finding_of("raised"))
    lines = [line.rstrip() for line in drawn(watch, child_of(tmp_path))]
    assert "stationary for 7 s, the wall is near  0.0 s old" in lines
    assert "model aaaaaaaa  raised: it is raised  0.0 s old" in lines
    assert lines[-2:] == ["a hint", "a warning"]


# the screen


class Terminal(io.StringIO):
    """A stream that counts as a terminal."""

    def isatty(self):
        return True


def test_a_terminal_is_redrawn_four_times_a_second(watch, clock, tmp_path, monkeypatch):
    """Independent of how often the loop runs."""
    clock.now = 50.0
    out = Terminal()
    monkeypatch.setattr(sys, "stderr", out)
    monkeypatch.setenv("TERM", "xterm")
    moments: list[float] = []
    with screen(watch, [child_of(tmp_path)], ["a hint"], tmp_path, quiet=False) as redraw:
        while clock.now < 52.0:
            before = len(out.getvalue())
            redraw()
            if len(out.getvalue()) > before:
                moments.append(clock.now)
            clock.now += 0.05
    assert "a hint" in out.getvalue()
    assert 7 <= len(moments) <= 9
    assert all(0.24 <= later - earlier <= 0.31 for earlier, later in pairwise(moments))


def test_a_pipe_gets_each_hint_once_and_the_live_view_once_it_is_known(watch, tmp_path, capsys):
    for quiet, notice in ((True, ""), (False, "a hint\nlive view http://127.0.0.1:9090\n")):
        watch.health.clear()
        with screen(watch, [child_of(tmp_path)], ["a hint"], tmp_path, quiet=quiet) as redraw:
            for turn in range(4):
                if turn == 2:
                    watch.health["dashboard"] = (health_of("dashboard", detail="http://127.0.0.1:9090"), 0.0)
                redraw()
        assert capsys.readouterr().err == notice


def test_the_address_of_the_page_is_shown_once_it_answers_and_asking_takes_no_time_from_the_loop(
    watch, clock, tmp_path, monkeypatch, capsys
):
    """The address is probed four times a second, for at most 0.05 s, and not again after it answered."""
    asked: list[float] = []

    def connected(address, seconds):
        assert address == ("127.0.0.1", 8080)
        asked.append(clock.now)
        clock.now += seconds
        if len(asked) < 5:
            raise TimeoutError
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr(socket, "create_connection", connected)
    clock.now = 50.0
    with screen(watch, [child_of(tmp_path)], [], tmp_path, quiet=False, page=PAGE) as redraw:
        for _ in range(300):
            before = clock.now
            redraw()
            assert clock.now - before <= 0.06
            assert (len(asked) == 5) or capsys.readouterr().err == ""
            clock.now += 0.01
    shown, file = capsys.readouterr().err, tmp_path / "page-address"
    assert shown == f"workbench http://127.0.0.1:8080/live (the address with its token is in {file}, for you alone)\n"
    assert file.read_text() == f"{PAGE}\n"
    assert file.stat().st_mode & 0o777 == 0o600
    assert [later - earlier for earlier, later in pairwise(asked)] == pytest.approx([0.25] * 4, abs=0.015)


# warnings


def test_a_warning_is_shown_within_half_a_second_and_its_like_five_seconds_later(clock, tmp_path):
    clock.now, reported, child = 100.0, list[tuple[float, str]](), child_of(tmp_path)

    def warn(kind):
        event = {"time": 1.0, "level": "warning", "kind": kind, "sentence": f"{kind} happened", "service": "policy"}
        with child.log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(event) + "\n")

    shown = LogWarnings((child,), tmp_path, lambda line: reported.append((clock.now - 100.0, line)))
    for turn in range(240):
        clock.now = 100.0 + 0.05 * turn
        warn("flood")
        if turn == 43:
            warn("once")
        shown.look()
    moments = {kind: [at for at, line in reported if kind in line] for kind in ("flood", "once")}
    first, second, third = moments["flood"]
    assert first <= 0.5
    assert [second - first, third - second] == pytest.approx([5.0, 5.0], abs=0.5)
    (once,) = moments["once"]
    assert 2.15 <= once <= 2.7
