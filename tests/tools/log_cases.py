"""Reads the logs of a folder of cases, and prints for each what is asked and what came out.

    python tests/tools/log_cases.py [FOLDER]

The folder (default: ``cases`` in the folder ``shared`` next to the checkout) is not part of the repository; it has a
folder for each case. All logs are of one drive, which is taken from one of the tables without the readers. Exits with
1 if a case is not as asked, and with 2 without the folder.
"""

import importlib
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import wrappers

from safedpa.errors import InputError
from safedpa.records import Run, load_column_map, load_run
from safedpa.robots.car.system import CAR
from safedpa.safety import GymnasiumSafetyFilter

DEFAULT = Path(__file__).resolve().parents[3] / "shared" / "cases"
Drive = np.ndarray
Check = Callable[[Path, Drive], str]


class CaseError(Exception):
    """A case is not as asked."""


def asked(condition: bool, text: str) -> None:
    """Raises CaseError with what was found instead."""
    if not condition:
        raise CaseError(text)


def drive_in(folder: Path) -> Drive:
    """The drive (rows, 7), parsed from text by hand: times, states, actions."""
    lines = (folder / "trailing_delimiter/03_trailing_delim_rows.csv").read_text(encoding="utf-8").splitlines()[1:]
    return np.array([[float(cell) for cell in line.split(",")[:7]] for line in lines])


def pairs(run: Run, drive: Drive, *, shift: int = 0) -> np.ndarray:
    """Row of the drive of each row of a run; raises CaseError if a state or its command is not of that row."""
    distances = ((run.states[:, None, [0, 1, 3]] - drive[None][:, :, [1, 2, 4]]) ** 2).sum(axis=2)
    rows = distances.argmin(axis=1)
    turn = np.angle(np.exp(1j * (run.states[:, 2] - drive[rows, 3])))
    states = (distances[np.arange(len(rows)), rows] > 1e-10) | (np.abs(turn) > 1e-5)
    wrong = np.abs(run.actions - drive[np.maximum(rows - shift, 0), 5:]).max(axis=1) > 1e-6
    asked(not states.any(), f"{int(states.sum())} of {len(rows)} rows have a state that the drive has not")
    asked(not wrong.any(), f"{int(wrong.sum())} of {len(rows)} rows have the command of another row")
    return np.asarray(rows)


def read(
    log: str, columns: str = "", rows: int = 499, segments: int = 1, finding: str = "", *, shift: int = 0
) -> Check:
    """Checks that a log is read: right pairs, at least so many rows, so many segments, and a finding of this kind."""

    def check(folder: Path, drive: Drive) -> str:
        run = load_run(folder / log, CAR, load_column_map(str(folder / columns)) if columns else None)
        found = set(pairs(run, drive, shift=shift).tolist())
        kinds = [item.kind for item in run.findings]
        asked(len(found) >= rows, f"{len(found)} rows, wanted {rows}")
        asked(len(run.stretches) == segments, f"{len(run.stretches)} segments, wanted {segments}")
        asked(not finding or finding in kinds, f"no finding '{finding}'")
        return f"{len(found)} rows in {segments} segments, every command right; {', '.join(kinds) or 'no finding'}"

    return check


def refused(log: str, columns: str, pattern: str) -> Check:
    """Checks that a log is refused in one line that matches."""

    def check(folder: Path, _: Drive) -> str:
        try:
            load_run(folder / log, CAR, load_column_map(str(folder / columns)))
        except InputError as error:
            text = str(error).replace(f"{folder}/", "")
            asked(re.search(pattern, text) is not None and "\n" not in text, text)
            return f"refused: {text}"
        raise CaseError("read, though nothing is whole in it")

    return check


def late_comma(folder: Path, drive: Drive) -> str:
    """A log that begins with 70 rows of zeros a second apart; they are no rows of the drive."""
    run = load_run(folder / "01_comma_late.csv", CAR)
    part = run.stretches[-1]
    rows = slice(part.start, part.stop)
    found = pairs(replace(run, t=run.t[rows], states=run.states[rows], actions=run.actions[rows]), drive)
    asked(any(item.kind == "decimal_comma" for item in run.findings), "no finding 'decimal_comma'")
    return f"{len(run.t)} rows, {len(found)} of them of the drive, all paired rightly"


def wrapper(folder: Path, _: Drive) -> str:
    """The filter's case: wrappers between the filter and the environment are refused in a line, by name."""
    sys.path.insert(0, str(folder))
    cart: Any = importlib.import_module("cartmod")
    below: dict[str, Callable[[], Any]] = {
        "RescaleAction": lambda: wrappers.RescaleAction(cart.Cart(0.4), np.float32(-1), np.float32(1)),
        "StickyAction": lambda: wrappers.StickyAction(cart.Cart(), 0.5),
        "DelayObservation": lambda: wrappers.DelayObservation(cart.Cart(), 5),
    }
    for name, made in below.items():
        try:
            GymnasiumSafetyFilter(made(), cart.make_filter())
        except InputError as error:
            asked(name in str(error) and "\n" not in str(error), str(error))
        else:
            raise CaseError(f"{name} below the filter is accepted")
    return f"refused by name: {', '.join(below)}"


CASES: tuple[tuple[str, str, Check], ...] = (
    ("sim_time_reset", "three segments; commands joined inside a segment only",
     read("04_sim_reset.mcap", "map.toml", 497, 3, "clock_reset")),
    ("clock_set_back", "two segments and a finding", read("05b_ntp_back.mcap", "map.toml", 498, 2, "clock_reset")),
    ("unstamped_messages", "judged per message; receipt time, with a finding",
     read("02_two_publishers_one_unstamped.mcap", "map.toml", 499, 1, "bad_stamp")),
    ("two_types_on_a_topic", "each channel by its own schema, or refused by name",
     read("07b_two_types.mcap", "map_tw.toml", 499, 1, "two_types")),
    ("wrapper_below_filter", "what changes action or observation is refused or modelled", wrapper),
    ("late_decimal_comma", "read: commas after row 60", late_comma),
    ("late_decimal_comma", "read: quoted ones between commas",
     read("40_quoted_decimal_comma.csv", finding="decimal_comma")),
    ("commas_in_header", "read",
     read("08_quoted_comma_header_semicolon.csv", "08_quoted_comma_header_semicolon.csv.toml")),
    ("iso_times", "read", read("11_iso_tz.csv")),
    ("parquet_timestamp", "read", read("61_timestamp_ns.parquet")),
    ("outer_joined", "hold for tables, two rates used: the command before each state",
     read("17_sparse_outer_join.csv", "", 498, 1, "joined_rates", shift=1)),
    ("rows_out_of_order", "sorted inside a segment, with a finding",
     read("16_swap_10.csv", finding="out_of_order")),
    ("first_chunk_cut", "cut off after N bytes; nothing can be read",
     refused("25_crashed.mcap", "map.toml", r"cut off after 32150 bytes; nothing can be read")),
    ("ulog_resubscribed", "all rows", read("05_resubscribed.ulg", "map.toml")),
    ("ulog_resubscribed", "a finding for the cut", read("06_cut.ulg", "map.toml", 298, 1, "cut_off")),
    ("trailing_delimiter", "read", read("03_trailing_delim_rows.csv")),
    ("missing_value_words", "missing values, with a finding", read("15_01.csv", "", 486, 10, "missing_value")),
    ("missing_value_words", "booleans are numbers", read("13_bool_armed.csv", "13_bool_armed.csv.toml", 478)),
    ("map_with_bom", "read", read("../hole_in_mcap/28_hole.mcap", "m_bom.toml", 480, 2, "damaged")),
    ("hole_in_mcap", "only the damaged chunk is lost", read("28_hole.mcap", "map.toml", 480, 2, "damaged")),
    ("list_columns", "action[0] in the map", read("66_list_columns.parquet", "66_list_columns.parquet.toml")),
)  # fmt: skip
"""Folder, what is asked, and the check."""


def main() -> int:
    """Prints a line for each case."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT
    if not folder.is_dir():
        print(f"{folder}: no such folder; the logs are not part of the repository: name their folder")
        return 2
    drive, failed = drive_in(folder), 0
    for name, wanted, check in CASES:
        try:
            mark, found = "right", check(folder / name, drive)
        except (CaseError, InputError, OSError) as error:
            mark, found, failed = "WRONG", str(error), failed + 1
        print(f"{mark:6}{name}: {wanted} -> {found}", flush=True)
    print(f"{len(CASES) - failed} of {len(CASES)} are as asked")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
