"""A recording may hold anything: replaying it ends in figures or one line, soon, and touches no file."""

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import pytest

from safedpa.bus import LATENT, SetupMessage
from safedpa.errors import InputError
from safedpa.replay.setups import node_of
from safedpa.replay.tape import RobotTape, gaps_of, read_tape
from safedpa_lab.experiments.hostile.targets import driven_again, recorded_drive, replayed, written

pytestmark = [pytest.mark.processes, pytest.mark.slow]

Messages = list[tuple[str, int, bytes]]
Change = Callable[[dict[str, Any]], object]


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> Messages:
    return recorded_drive(tmp_path_factory.mktemp("drive"))


def changed(messages: Messages, topic: str, change: Change, path: Path, *, which: int = 20) -> Path:
    """A recording in which one message of a topic says something else."""
    found = list(messages)
    places = [index for index, (key, _, _) in enumerate(found) if f"/{topic}" in key]
    index = places[min(which, len(places) - 1)]
    table = msgpack.unpackb(found[index][2])
    change(table)
    found[index] = (*found[index][:2], msgpack.packb(table))
    written(found, path)
    return path


def options_changed(**options: Any) -> Change:
    return lambda table: table.update(options=json.dumps({**json.loads(table["options"]), **options}))


def test_the_drive_itself_comes_out_again(messages: Messages, tmp_path: Path) -> None:
    written(messages, tmp_path / "run.mcap")
    document, _ = replayed(tmp_path / "run.mcap")
    assert json.loads(document)["agrees"]
    _, driven = driven_again(tmp_path / "run.mcap")
    assert json.loads(driven)["apart_from_tick"] is None


@pytest.mark.parametrize("unknown", [{1: 2}, {b"\xff": []}, [[[[1]]]]])
def test_a_field_of_a_later_version_may_hold_anything(messages: Messages, tmp_path: Path, unknown: Any) -> None:
    path = changed(messages, "state", lambda table: table.update(later=unknown), tmp_path / "run.mcap", which=0)
    document, _ = replayed(path)
    assert json.loads(document)["agrees"]


@pytest.mark.parametrize("rows", [[[0.0, 1.0]], [[0.0]] * 2, [[]] * 2, [[0.0, 1.0, 2.0]] * 2, [[0.0, 1.0]] * 40])
def test_a_trace_of_another_shape_is_left_out_and_reported(messages: Messages, tmp_path: Path, rows: list[Any]) -> None:
    path = changed(messages, "verdict", lambda table: table.update(consumed=rows), tmp_path / "run.mcap")
    replayed(path)
    assert any(finding.kind == "unreadable_trace" for finding in read_tape([path]).findings)


@pytest.mark.long
@pytest.mark.parametrize("topic", ["latent", "nominal", "verdict", "state"])
def test_a_tick_far_away_costs_no_time(messages: Messages, tmp_path: Path, topic: str) -> None:
    """Nine quadrillion ticks were counted one by one."""
    path = changed(messages, topic, lambda table: table.update(tick=(1 << 53) - 1), tmp_path / "run.mcap", which=39)
    written(messages, tmp_path / "as_it_was.mcap")
    plain = min(_processor_seconds(partial(replayed, tmp_path / "as_it_was.mcap")) for _ in range(3))
    assert min(_processor_seconds(partial(replayed, path)) for _ in range(3)) < 5.0 * plain


def _processor_seconds(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


@pytest.mark.parametrize(
    ("options", "phrase"),
    [
        ({"seed": "x"}, "--seed"), ({"rate": "fast"}, "--rate"), ({"load": "moon"}, "--load"),
        ({"seed": 1e300}, "--seed"),
        ({"robot": ["a", "b"]}, "robot"), ({"rate": 1e9}, "--rate"),
        ({"change_after": {"a": 1}}, "--change-after"),
        ({"robot": "\x1b[2J"}, "robot"), ({"world": ["a=b"]}, "world"),
    ],
)  # fmt: skip
def test_options_that_no_robot_has_are_refused(messages, tmp_path, options, phrase):
    path = changed(messages, "setup/robot", options_changed(**options), tmp_path / "run.mcap")
    with pytest.raises(InputError, match=phrase) as refusal:
        driven_again(path)
    assert str(refusal.value).isprintable()


def test_files_that_a_recording_names_are_left_alone(messages: Messages, tmp_path: Path) -> None:
    files = {name: str(tmp_path / f"{name}.txt") for name in ("summary", "trace", "certificates")}
    path = changed(messages, "setup/robot", options_changed(**files, listen=["tcp/0.0.0.0:7"]), tmp_path / "run.mcap")
    driven_again(path)
    assert [file.name for file in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("name", ["x" * 5000 + ".toml", "\x00.toml", "/" * 5000 + ".toml"])
def test_a_model_s_name_that_no_file_can_have(messages: Messages, tmp_path: Path, name: str) -> None:
    path = changed(messages, "setup/policy", options_changed(model=name), tmp_path / "run.mcap")
    setup = read_tape([path]).setups["policy"][0][1]
    assert node_of(setup).name == "policy"
    replayed(path)


@pytest.mark.long
def test_many_starts_and_epochs_take_no_longer_than_they_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    few = min(_processor_seconds(partial(_started, 1_000)) for _ in range(5))
    many = min(_processor_seconds(partial(_started, 20_000)) for _ in range(2))
    assert many < 100.0 * few, "20 times as many; hundreds of times as long where each looks at all others"
    tape, asked = _started(20_000), []
    monkeypatch.setattr(
        RobotTape, "absent", lambda self, topic: asked.append(topic) or {(epoch, 3) for epoch in range(50)}
    )
    assert len(gaps_of(tape)) == 100
    assert asked.count(LATENT) == 1


def _started(processes: int) -> RobotTape:
    tape = RobotTape("r1", ())
    stamp = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    for number in range(processes):
        tape.add_setup(
            number, SetupMessage(**stamp, service="policy", instance=str(number), pid=1, software="", options="")
        )
    return tape


@pytest.mark.parametrize("topic", ["action", "state"])
@pytest.mark.parametrize("entries", [0, 1, 3])
def test_an_action_of_another_size_than_the_robot_s(messages: Messages, tmp_path: Path, topic: str, entries: int):
    name = {"action": "action", "state": "applied"}[topic]
    path = changed(messages, topic, lambda table: table.update({name: [0.25] * entries}), tmp_path / "run.mcap")
    driven_again(path)
