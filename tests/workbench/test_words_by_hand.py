"""What the workbench says in words: of a robot that is silent or stands, for and against a candidate, of columns."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.diagnosis.document import Candidate, Value
from safedpa.dynamics import load_model
from safedpa.records import McapRecorder
from safedpa_services.workbench.evidence import card_of
from safedpa_services.workbench.live_book import RobotBook
from safedpa_services.workbench.open_dialog import OpenDialog


@pytest.fixture
def book() -> RobotBook:
    return RobotBook("r1")


def driven(seconds: float = 10.0, goals: int = 3, collisions: int = 0) -> Any:
    return SimpleNamespace(robot_time=seconds, goals_reached=goals, collisions=collisions)


def test_the_account_of_a_drive_counts_its_goals_and_collisions(book: RobotBook) -> None:
    assert book.account() == "Nothing was driven."
    book.state = driven()
    assert book.account() == "r1 drove for 10 s: 3 goals, 0 collisions."
    book.state = driven(61.4, 1, 1)
    assert book.account() == "r1 drove for 61 s: 1 goal, 1 collision."


@pytest.mark.parametrize(
    ("seen", "found", "told"),
    [
        (1.0, 1.0, ""),
        (2.9, 2.9, ""),
        (4.0, 1.0, "r1 was heard last 4 s ago: its drive has ended"),
        (4.0, None, "r1 was heard last 4 s ago: its drive has ended"),
        (1.0, 4.0, "The diagnosis is silent since 4 s."),
        (1.0, None, "No diagnosis is heard"),
    ],
)
def test_who_is_silent_is_named_the_robot_first(book: RobotBook, seen: float, found: float | None, told: str) -> None:
    """Both speak at least once a second; a few lost words are no silence."""
    book.state, book.seen = driven(), 100.0 - seen
    book.found = None if found is None else 100.0 - found
    said = book.silence(100.0)
    assert said.startswith(told)
    assert bool(said) is bool(told)
    assert ("r1 drove for 10 s" in said) is (seen > 3.0)


def test_a_robot_that_stands_is_said_to_stand_as_long_as_it_does(book: RobotBook) -> None:
    assert book.standstill() == "", "before a verdict nothing is known"
    verdict: Any = SimpleNamespace(standstill="", stands=9.0)
    book.verdict = verdict
    assert book.standstill() == "", "it stands where nobody wishes that it moves"
    verdict.standstill = "margin: obstacle leave less room"
    assert book.standstill().startswith("r1 stands for 9 s, margin: obstacle leave less room. ")
    assert len(book.standstill()) > len("r1 stands for 9 s, margin: obstacle leave less room. "), "and what to do"


def candidate(score: float | None, error: float | None = 0.2, std: float | None = 0.05) -> Candidate:
    numbers = {"coefficient": Value(0.5, std, "1/m")}
    return Candidate(0, "quadratic_drag", numbers, error, score, (), "rejected", "")


@pytest.mark.parametrize(
    ("score", "spoken_for", "spoken_against"),
    [
        (None, "", "no gain on unseen stretches may be chance"),
        (-1.0, "", "a gain of -1.0 standard errors"),
        (1.9, "", "a gain of 1.9 standard errors"),
        (2.5, "2.5 standard errors: hardly chance", ""),
        (3.5, "3.5 standard errors: clear of chance", ""),
    ],
)
def test_a_gain_of_less_than_two_standard_errors_speaks_against_and_a_larger_one_for(
    score: float | None, spoken_for: str, spoken_against: str
) -> None:
    """By chance alone one of 44 gains is larger than two standard errors, one of 740 than three."""
    card = card_of("car", candidate(score), 0.5, None, {})
    gained = [line for line in card.speaks_for if "standard errors" in line]
    doubted = [line for line in card.speaks_against if "unseen stretches" in line]
    assert (len(gained), len(doubted)) == (bool(spoken_for), bool(spoken_against))
    assert all(line.endswith(spoken_for) for line in gained)
    assert all(line.startswith(spoken_against) for line in doubted)


@pytest.mark.parametrize(
    ("error", "spoken_for", "spoken_against"),
    [
        (0.25, "0.5 → 0.25 (−50 %)", ""),
        (0.499, "", "hardly changes"),
        (0.501, "", "hardly changes"),
        (0.6, "", "rises 0.5 → 0.6"),
        (None, "", "too little to be tried"),
    ],
)
def test_an_error_that_falls_speaks_for_and_one_that_does_not_against(
    error: float | None, spoken_for: str, spoken_against: str
) -> None:
    card = card_of("car", candidate(4.0, error), 0.5, None, {})
    fell = [line for line in card.speaks_for if "→" in line]
    stayed = [line for line in card.speaks_against if "error on data" in line or "tried" in line]
    assert (len(fell), len(stayed)) == (bool(spoken_for), bool(spoken_against))
    assert all(spoken_for in line for line in fell)
    assert all(spoken_against in line for line in stayed)


@pytest.mark.parametrize(
    ("std", "known", "rough"), [(0.05, "10 %", ""), (0.1, "", ""), (0.2, "", "40 %"), (None, "", "999 %")]
)
def test_a_number_is_well_known_or_roughly(std: float | None, known: str, rough: str) -> None:
    """Of 0.5: 0.05 are a tenth, 0.2 two fifths; one without a deviation is known to nobody."""
    card = card_of("car", candidate(4.0, 0.2, std), 0.5, None, {})
    assert [line.partition("known to ")[2] for line in card.speaks_for if "known to" in line] == [known] * bool(known)
    said = [line.partition("only to ")[2] for line in card.speaks_against if "known only" in line]
    assert said == [rough] * bool(rough)


class Dialog:
    """The dialog without its page: which map it has chosen, and whether it has read the columns through it."""

    def __init__(self, chosen: str, model: str | None, paths: list[Path]) -> None:
        self.dialog = object.__new__(OpenDialog)
        self.map, self.read, self.said = SimpleNamespace(value=chosen), list[str](), list[str]()
        self.dialog.__dict__ |= {
            "_map": self.map,
            "_loaded_model": lambda: None if model is None else load_model(model),
            "_files_named": lambda: [str(path) for path in paths],
            "_map_chosen": lambda: self.read.append(self.map.value),
            "_say": self.said.append,
        }
        self.dialog._refresh()


NATIVE, GUESSED = "native names", "guessed from the names"
HEADERS = {
    "own": "t,x,y,yaw,speed,target_speed,steer",
    "dart": "elapsed time sensors,vicon time,vicon x,vicon y,vicon yaw,throttle,steering",
    "strange": "time,east,north",
}


@pytest.mark.parametrize(
    ("header", "chosen", "map_then", "read"),
    [
        ("own", NATIVE, NATIVE, [NATIVE]),
        ("dart", NATIVE, "dart_car_columns", []),  # the page itself reads when the choice changes
        ("strange", NATIVE, GUESSED, []),
        ("strange", "dart_car_columns", "dart_car_columns", ["dart_car_columns"]),  # a person's own choice stands
        ("dart", GUESSED, GUESSED, [GUESSED]),
        ("own", "dart_car_columns", "dart_car_columns", ["dart_car_columns"]),
        ("", NATIVE, NATIVE, [NATIVE]),  # a recording of the bus has no columns
    ],
)
def test_a_map_that_fits_is_chosen_where_nobody_chose_one(
    header: str, chosen: str, map_then: str, read: list[str], tmp_path: Path
) -> None:
    path = tmp_path / ("run.csv" if header else "run.mcap")
    if header:
        path.write_text(f"{HEADERS[header]}\n" + "0," * HEADERS[header].count(",") + "0\n", encoding="utf-8")
    else:
        with McapRecorder(path):
            pass
    made = Dialog(chosen, "car", [path])
    assert (made.map.value, made.read, made.said) == (map_then, read, [])


@pytest.mark.parametrize(("model", "named"), [(None, True), ("car", False), (None, False)])
def test_without_a_model_or_a_recording_no_columns_are_read(model: str | None, named: bool, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(HEADERS["dart"], encoding="utf-8")
    made = Dialog(NATIVE, model, [path] if named else [])
    assert (made.map.value, made.read, made.said) == (NATIVE, [], [])
