"""Whatever happens to a file, reading it gives a run without bad numbers, or one sentence; never another error."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.messages import StateMessage
from safedpa.bus.messages.topics import STATE, key_of
from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records import McapRecorder, Run, load_run
from safedpa.robots.car.system import CAR

ODD_CELLS = st.sampled_from(
    [
        "",
        "nan",
        "inf",
        "-inf",
        "1e400",
        "1e-400",
        "abc",
        '"',
        "1,2",
        "\n",
        "\r",
        "0",
        "-0",
        "é",
        "1\x0b",
        "\x0c0",
        "1_0",
        "\u0661",
    ]
)
EDITS = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 6), ODD_CELLS), max_size=6)


def sound(path: Path) -> bool:
    """Whether the file was read; asserts what must hold either way."""
    try:
        run = load_run(path, CAR)
    except (RunError, LimitError) as error:
        sentence = str(error)
    else:
        assert_trustworthy(run)
        return True
    assert "\n" not in sentence
    assert str(path) in sentence
    return False


def assert_trustworthy(run: Run) -> None:
    assert run.stretches
    for t, states, actions in run.parts():
        assert len(t) >= 5
        assert np.all(np.diff(t) > 0.0)
        assert np.isfinite(states).all()
        assert np.isfinite(actions).all()
    assert sum(len(part) for part in run.stretches) == len(run.t)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damage")


@settings(max_examples=150, deadline=None)
@given(edits=EDITS, keep=st.integers(0, 4000), swap=st.integers(0, 40))
def test_a_damaged_csv_file(folder: Path, edits: list[tuple[int, int, str]], keep: int, swap: int) -> None:
    t = 0.05 * np.arange(40)
    table = np.column_stack([t, np.sin(t), 1 - np.cos(t), t, 1 + 0 * t, 1 + 0.1 * np.sin(3 * t), 0.3 * np.cos(t)])
    cells = [[f"{value:.6g}" for value in row] for row in table.tolist()]
    cells.insert(0, ["t", "x", "y", "yaw", "speed", "target_speed", "steer"])
    for row, column, text in edits:
        cells[row][column] = text
    cells[1:] = cells[1 + swap :] + cells[1 : 1 + swap]
    (folder / "drive.csv").write_bytes("\n".join(",".join(row) for row in cells).encode()[: keep or None])
    sound(folder / "drive.csv")


@pytest.mark.parametrize(("cell", "value"), [("1.25\x0b", 1.25), ("\x0c1.25", 1.25), ("1_0", None), ("\u0661", None)])
def test_what_one_reader_takes_for_a_number_and_the_other_does_not(tmp_path: Path, cell: str, value: float | None):
    """Blanks of any kind around a number are blanks; other scripts and underscores are no numbers of a sensor."""
    path = tmp_path / "odd.csv"
    rows = [[f"{0.05 * number:.2f}", "0", "0", "0", "1", "1", "0"] for number in range(40)]
    rows[20][4] = cell
    path.write_text("\n".join(["t,x,y,yaw,speed,target_speed,steer", *map(",".join, rows)]) + "\n", encoding="utf-8")
    if value is None:
        with pytest.raises(RunError, match=r"line 22, column 'speed': got .* wanted a number"):
            load_run(path, CAR)
    else:
        assert load_run(path, CAR).states[20, 3] == value


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_very_short_files_are_refused_in_a_sentence(folder: Path, rows: int) -> None:
    lines = "\n".join(f"{0.05 * k},{k},0,0,1,1,0.1" for k in range(rows))
    (folder / "short.csv").write_text("t,x,y,yaw,speed,target_speed,steer\n" + lines)
    assert not sound(folder / "short.csv")


@pytest.fixture(scope="module")
def recording(folder: Path) -> bytes:
    with McapRecorder(folder / "good.mcap") as recorder:
        for tick in range(300):
            t = 0.05 * tick
            message = StateMessage(
                epoch=1,
                tick=tick,
                robot_time=t,
                publish_time=t,
                values=(np.sin(t), 1 - np.cos(t), t, 1.0),
                applied=(1 + 0.1 * np.sin(t), 0.3 * np.cos(t)),
                applied_by="filter",
                period=0.05,
                lockstep=True,
                goal=(0.0, 0.0),
                obstacles=(),
                field=(-4.0, 4.0, -4.0, 4.0),
                footprint=(0.1, 0.4, 0.1),
            )
            recorder.write(key_of("fleet", "one", STATE), encode(message), int(1e9 * t), int(1e9 * t))
    return (folder / "good.mcap").read_bytes()


@settings(max_examples=150, deadline=None)
@given(
    places=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=5),
    keep=st.floats(0.0, 1.0),
)
def test_a_damaged_recording(folder: Path, recording: bytes, places: list[tuple[float, int]], keep: float) -> None:
    data = bytearray(recording)
    for place, value in places:
        data[min(int(place * len(data)), len(data) - 1)] = value
    (folder / "drive.mcap").write_bytes(data[: max(1, int(keep * len(data)))])
    sound(folder / "drive.mcap")


@pytest.mark.parametrize("value", [1, 128])
def test_a_chunk_that_claims_more_bytes_than_any_memory_has(folder: Path, recording: bytes, value: int) -> None:
    data = bytearray(recording)
    chunk = data.index(b"zstd") + len(b"zstd")
    data[chunk + 7] = value  # highest byte of the length of its data
    (folder / "greedy.mcap").write_bytes(data)
    sound(folder / "greedy.mcap")
