"""Names and sentences that others chose: on terminal, pages, in reports and logs they are text and nothing else."""

import io
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from safedpa.bus import STATE, HealthMessage, key_of
from safedpa.bus.logging import EventLog
from safedpa.bus.messages.topics import topic_of
from safedpa.errors import InputError
from safedpa.limits import readable
from safedpa_services.command_line.group import safedpa
from safedpa_services.plain_output import print_plain
from safedpa_services.supervisor.log_warnings import readable as event_line
from safedpa_services.terminal import terminal

HOSTILE = (
    "\x1b[2J\x1b[H",  # clears the screen
    "\x1b]0;owned\x07",  # names the window
    "\x1b]8;;http://evil.example\x1b\\click\x1b]8;;\x1b\\",  # a link
    "\x1b]52;c;cm0gLXJmIH4=\x07",  # writes the clipboard
    "\x9b31m",  # the same in one byte
    "a\rb",  # writes over the line
    "a\bb",
    "a\nsafedpa: all is well",
    "\u202egnp.exe",  # turns the direction
    "\u2066hidden\u2069",
    "\u200b",
    "\u2028",
    "[link=http://evil.example]click[/link]",
    "[bold red]trouble[/]",
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "</script><script>alert(1)</script>",
    "{{7*7}}",
    "\ud800",
    "x" * 100_000,
)
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069]")


def drawn(what: Any, *, colours: bool = False) -> str:
    """As a terminal would get it, without its own colours unless they are wanted."""
    file = io.StringIO()
    terminal(file=file, width=400, force_terminal=colours, color_system=None).print(what)
    return file.getvalue()


@pytest.mark.parametrize("name", HOSTILE[:-1])
def test_no_robot_s_name_holds_what_is_not_printed(name: str) -> None:
    if name.isprintable() and not set(name) & set("/*$#?"):
        assert topic_of(f"safedpa/f/{name}/state")[1] == name
    else:
        with pytest.raises(InputError) as refusal:
            key_of("f", name, STATE)
        assert not CONTROL.search(str(refusal.value))


def test_no_name_is_longer_than_a_screen() -> None:
    with pytest.raises(InputError, match="more than 128"):
        key_of("f", "x" * 129, STATE)


@given(st.text(max_size=300))
@example("a\xa0b")
def test_what_is_readable_is_printable_and_short(text: str) -> None:
    assert readable(text, 100).isprintable()
    assert len(readable(text, 100)) < 100 * 10 + 30


@pytest.mark.parametrize("text", HOSTILE)
def test_a_terminal_shows_it_as_text(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    print_plain(text.encode("utf-8", "replace").decode())
    assert not CONTROL.search(capsys.readouterr().out.replace("\n", ""))
    if text.isascii() and text.isprintable() and len(text) < 300:
        assert text in drawn(text), "markup is text as well"
    assert not CONTROL.search(drawn(text.encode("utf-8", "replace").decode()).replace("\n", ""))


@pytest.mark.parametrize("text", HOSTILE[:-2])
def test_the_table_of_processes_shows_it_as_text(text: str) -> None:
    from safedpa_services.supervisor.child import Child
    from safedpa_services.supervisor.view import render_view

    message = HealthMessage(
        epoch=0, tick=0, robot_time=0.0, publish_time=0.0, service="policy", pid=1, state=text, detail=text
    )
    watch: Any = SimpleNamespace(
        state=None,
        verdict=None,
        finding=None,
        health={"policy": (message, 0.0)},
        silent_for=lambda _: 0.0,
        ages=lambda: (None, None),
    )
    policy, robot = (Child(name, "", (), Path("log")) for name in ("policy", "robot"))
    shown = drawn(render_view(watch, [robot, policy], [text], [text]))
    assert "policy" in shown
    assert not CONTROL.search(shown)


@pytest.mark.parametrize("text", HOSTILE[:-2])
def test_a_line_of_the_log_is_one_line_of_text(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    for mode in ("text", "json"):
        monkeypatch.setenv("SAFEDPA_LOG", mode)
        EventLog(lines.append).log({"time": 0.0, "level": "info", "kind": "x", "sentence": text, "robot": text})
    assert all(line.count("\n") == 1 and not CONTROL.search(line[:-1]) for line in lines)
    assert json.loads(lines[1])["robot"] == text
    assert not CONTROL.search(event_line({"sentence": text, "service": text, "robot": text}))


@pytest.mark.parametrize("text", HOSTILE)
def test_a_page_shows_it_as_text(text: str) -> None:
    pytest.importorskip("nicegui")
    from safedpa_services.workbench.panels.elements import escaped

    shown = escaped(text)
    assert not set(shown) & set('<>"')
    assert not CONTROL.search(shown.replace("\n", ""))


@pytest.mark.parametrize("text", HOSTILE[:-2])
def test_a_report_holds_it_as_text(text: str) -> None:
    from safedpa.report.comparison_page import embedded

    assert "<" not in embedded({"name": text})
    assert ">" not in embedded({"name": text})


@pytest.mark.parametrize("column", ["\x1b[2J", "</script><script>alert(1)</script>", "[link=x]y[/link]", "\u202ex"])
def test_a_column_s_name_comes_back_as_text(column: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"{column.replace('/', '_')}.csv"
    path.write_text(f"t,{column}\n0,1\n", encoding="utf-8")
    assert safedpa.run(["compare", "car", str(path)]) == 2
    notice = capsys.readouterr().err
    assert notice.count("\n") == 1
    assert not CONTROL.search(notice[:-1])


@pytest.mark.parametrize("command", ["compare", "diagnose"])
def test_a_file_s_name_is_text_in_the_report(command: str, tmp_path: Path) -> None:
    """Of a car that is stationary too, in which no share of the error is a number."""
    path = tmp_path / "\x1b[2J\u202e<b>.csv"
    rows = "".join(f"{0.05 * k:.2f},{0.05 * k:.3f},0,0,1,1,0\n" for k in range(200))
    path.write_text(f"t,x,y,yaw,speed,target_speed,steer\n{rows}", encoding="utf-8")
    assert safedpa.run([command, "car", str(path), "--out", str(tmp_path / "out")]) == 0
    (page,) = (tmp_path / "out").glob("*.html")
    text = page.read_text(encoding="utf-8")
    assert not set(text) & set("\x1b\u202e")
    assert "2J\\u202e" in text


def test_a_file_s_name_that_is_no_text_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run\udcff.csv"
    path.write_text("t,x\n0,1\n", encoding="utf-8")
    assert safedpa.run(["compare", "car", str(path)]) == 2
    notice = capsys.readouterr().err
    assert notice.count("\n") == 1
    assert "its name is not UTF-8" in notice


def test_a_cell_of_many_lines_costs_one_line(tmp_path: Path) -> None:
    """A quote that does not end makes one cell of the rest of the file."""
    from safedpa.records import load_run
    from safedpa.robots.car.system import CAR

    rows = "".join(f"{0.05 * k:.2f},0,0,0,1,1,0\n" for k in range(40))
    file = tmp_path / "run.csv"
    text = f't,x,y,yaw,speed,target_speed,steer\n{rows}9.0,0,0,0,1,1,"0\n{rows}"\n{rows}'
    for content in (text, text.replace('"0', '"\x1b[2J')):
        file.write_text(content, encoding="utf-8")
        with pytest.raises(InputError) as refusal:
            load_run(file, CAR)
        assert "\n" not in str(refusal.value)
        assert "\x1b" not in str(refusal.value)
        assert len(str(refusal.value)) < 600
