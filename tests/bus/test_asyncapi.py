"""The AsyncAPI document: current, and its schemas say of every sample of every released version that it is valid."""

import json
from pathlib import Path

import jsonschema
import msgpack
import pytest

from safedpa.bus import TOPICS

ROOT = Path(__file__).parents[2]
DOCUMENT = json.loads((ROOT / "docs" / "reference" / "asyncapi.json").read_text(encoding="utf-8"))
SAMPLES = sorted((Path(__file__).parent / "samples").glob("*.msgpack"))


def schema(name: str) -> dict[str, object]:
    message = DOCUMENT["components"]["schemas"][TOPICS[name].message.__name__]
    return {**message, "components": DOCUMENT["components"]}


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda path: path.stem)
def test_samples_are_valid_and_spoilt_ones_are_not(sample: Path) -> None:
    name = sample.name.split(".")[0]
    message = msgpack.unpackb(sample.read_bytes())
    jsonschema.validate(message, schema(name))
    for key, value in (("tick", -1), ("epoch", "one"), ("robot_time", 1e13)):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**message, key: value}, schema(name))
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({k: v for k, v in message.items() if k != "tick"}, schema(name))


def test_every_topic_is_there_under_its_key() -> None:
    assert set(DOCUMENT["channels"]) == set(TOPICS)
    assert DOCUMENT["channels"]["state"]["address"] == "safedpa/{fleet}/{robot}/state"
    assert DOCUMENT["channels"]["health"]["address"] == "safedpa/{fleet}/{robot}/health/{service}"
    assert DOCUMENT["operations"]["write_action"]["summary"] == "written by safety_filter"
