"""Files of format 1 convert to format 2 and mean the same; recordings of format 1 are also read directly."""

import json
from pathlib import Path

import msgpack
import pytest

from safedpa.bus import SetupMessage, TakeoverMessage, VerdictMessage, decode
from safedpa.errors import InputError
from safedpa.records.earlier_format import current_key, current_payload, migrate
from safedpa.records.readers.mcap import read_messages
from safedpa.safety import load_settings
from safedpa.safety.margins.calibration import MarginCalibration, margin_from_text
from safedpa_services.command_line.group import safedpa

SAMPLES = Path(__file__).parent / "samples"
MODELS = Path(__file__).parents[2] / "shared" / "safedpa" / "dynamics" / "models"
RECORDING = SAMPLES / "format_1.mcap"
MARGIN = """format = 1
coverage = 0.99
transitions = 500
date = "2026-11-21"
fingerprint = "abc"
[epsilon]
"obstacle" = 0.02
[constants]
"ceiling.obstacle" = 0.5
"drive.ceiling.obstacle" = 1.0
"""


def test_a_recording_is_read_directly_and_converted_to_the_same_messages(tmp_path: Path) -> None:
    findings: list = []
    direct = list(read_messages(RECORDING, findings))
    assert findings == []
    assert migrate(RECORDING, tmp_path / "new.mcap") == "recording"
    converted = list(read_messages(tmp_path / "new.mcap", findings))
    assert findings == []
    assert converted == direct
    verdicts = [message for _, _, message in direct if isinstance(message, VerdictMessage)]
    assert sum(len(verdict.nominal) == 1 for verdict in verdicts) == 100
    assert {key.rsplit("/", 1)[1] for key, _, _ in direct} >= {"nominal", "verdict", "state"}
    assert b"/wish" not in (tmp_path / "new.mcap").read_bytes()


@pytest.mark.parametrize("topic", ["setup", "model"])
def test_the_margin_in_a_message_keeps_its_constants(topic: str) -> None:
    margin = {"constants": {"ceiling.corridor": 0.4, "drive.ceiling.corridor": 0.3, "other": 1.0}, "coverage": 0.99}
    fields = {"version": 1, "margin": json.dumps(margin)}
    converted = json.loads(msgpack.unpackb(current_payload(topic, msgpack.packb(fields)))["margin"])
    assert converted == {
        "constants": {"clip.corridor": 0.4, "drive.clip.corridor": 0.3, "other": 1.0},
        "coverage": 0.99,
    }
    for odd in ("", "no JSON", "[1]", '{"constants": 1}', "[" * 20_000):  # a hostile recording
        payload = msgpack.packb({"version": 1, "margin": odd})
        assert msgpack.unpackb(current_payload(topic, payload))["margin"] == odd


def test_the_margin_of_a_recorded_filter_keeps_its_clips() -> None:
    setups = [message for _, _, message in read_messages(RECORDING, []) if isinstance(message, SetupMessage)]
    (margin,) = (margin_from_text(setup.margin) for setup in setups if setup.margin)
    assert {name: value for name, value in margin.constants.items() if "clip" in name} == {
        "clip.corridor": 0.4,
        "drive.clip.corridor": 0.4,
    }


def test_settings_keep_their_values(tmp_path: Path) -> None:
    source = SAMPLES / "settings_format_1.toml"
    with pytest.raises(InputError, match="safedpa migrate"):
        load_settings(source)
    assert migrate(source, tmp_path / "new.toml") == "settings"
    settings = load_settings(tmp_path / "new.toml")
    assert (settings.plausible_nominal, settings.eta, settings.action_high) == (4.0, 0.15, (1.8, 0.34))
    assert "# ranges" in (tmp_path / "new.toml").read_text(), "comments stay"


def test_margins_keep_their_values(tmp_path: Path) -> None:
    (tmp_path / "margin.toml").write_text(MARGIN)
    assert migrate(tmp_path / "margin.toml", tmp_path / "new.toml") == "margin"
    margin = MarginCalibration.load(tmp_path / "new.toml")
    assert margin.constants == {"clip.obstacle": 0.5, "drive.clip.obstacle": 1.0}
    assert margin.epsilon == {"obstacle": 0.02}


def test_a_robot_file_keeps_its_tables(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text('format = 1\nrobot = "car"\n[wish]\ntopic = "/in"\n')
    assert migrate(tmp_path / "robot.toml", tmp_path / "new.toml") == "robot file"
    assert (tmp_path / "new.toml").read_text() == 'format = 2\nrobot = "car"\n[nominal]\ntopic = "/in"\n'


def test_models_and_column_maps_are_copied(tmp_path: Path) -> None:
    column_map = Path(__file__).parents[2] / "shared" / "safedpa" / "records" / "maps" / "dart_car_bag.toml"
    for source, kind in ((MODELS / "car.toml", "model"), (column_map, "column map")):
        assert migrate(source, tmp_path / source.name) == kind
        assert (tmp_path / source.name).read_bytes() == source.read_bytes()


def test_fields_of_format_1_get_their_current_names_and_others_stay() -> None:
    stamp = {"version": 1, "epoch": 1, "tick": 2, "robot_time": 0.1, "publish_time": 1.0}
    answer = {"service": "policy", "change": 1, "fingerprint": "ab", "state": "ready", "foretold": "wider"}
    message = decode(TakeoverMessage, current_payload("takeover", msgpack.packb({**stamp, **answer})))
    assert message.expected_effect == "wider"
    newer = msgpack.packb({**stamp, "version": 2, "foretold": "unknown field of a newer program"})
    assert current_payload("takeover", newer) is newer
    for version in ("1", None, 1.5, [1]):  # a hostile recording
        odd = msgpack.packb({**stamp, "version": version, "foretold": "x"})
        assert current_payload("takeover", odd) is odd
    assert current_payload("takeover", b"foretold, but no msgpack") == b"foretold, but no msgpack"
    assert current_key("safedpa/f/r/wish") == "safedpa/f/r/nominal"
    assert current_key("safedpa/f/wish/state") == "safedpa/f/wish/state", "a robot may have that name"


def test_nothing_is_overwritten_and_what_is_no_file_of_the_project_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text("a = 1\n")
    with pytest.raises(InputError, match="no settings, model, column map, margin or robot file"):
        migrate(tmp_path / "other.toml", tmp_path / "new.toml")
    assert not (tmp_path / "new.toml").exists()
    with pytest.raises(InputError, match="exists already"):
        migrate(RECORDING, tmp_path / "other.toml")


def test_the_command_converts_what_it_can_and_reports_the_rest(tmp_path: Path, capsys) -> None:
    (tmp_path / "margin.toml").write_text(MARGIN)
    (tmp_path / "other.toml").write_text("a = 1\n")
    assert safedpa.run(["migrate", str(tmp_path / "margin.toml"), str(tmp_path / "other.toml")]) == 2
    notice = capsys.readouterr()
    assert "margin, written to" in notice.out
    assert "1 of 2 files were not converted" in notice.err
    assert MarginCalibration.load(tmp_path / "margin.format2.toml").coverage == 0.99


@pytest.mark.parametrize(
    ("text", "converted"),
    [
        ("eta = 0.2\n  plausible_wish = 3.0\n \tslack_linear=2.0\n", "eta = 0.2\n  plausible_nominal = 3.0\n"),
        ('format = 1\nrobot = "car"\nwish = { topic = "/in" }\n', None),
        ('format = 1\neta = 0.2\n"plausible_wish" = 3.0\n', None),
    ],
)
def test_what_cannot_be_converted_exactly_is_refused(text: str, converted: str | None, tmp_path: Path) -> None:
    (tmp_path / "old.toml").write_text(text)
    if converted is None:
        with pytest.raises(InputError, match="unusual way"):
            migrate(tmp_path / "old.toml", tmp_path / "new.toml")
        assert not (tmp_path / "new.toml").exists()
    else:
        migrate(tmp_path / "old.toml", tmp_path / "new.toml")
        assert (tmp_path / "new.toml").read_text() == converted
