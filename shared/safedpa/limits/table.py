"""The table of limits, and the environment variable that changes them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache

from safedpa.errors import InputError

VARIABLE = "SAFEDPA_LIMITS"
"""Environment variable that sets limits: ``name=number,name=number``. Child processes inherit it."""
_MEBI = 1024 * 1024


class LimitError(InputError):
    """An input is larger than its limit; the message names the limit."""


@dataclass(frozen=True)
class Limit:
    """One entry of the table."""

    name: str
    value: int
    of: str
    """What is measured."""
    why: str
    """Reason for the value."""


TABLE: dict[str, Limit] = {
    item.name: item
    for item in (
        Limit("toml_bytes", _MEBI // 4, "bytes of a TOML text", "the largest that ships has 3 KB"),
        Limit("toml_depth", 12, "nested brackets in TOML", "files of our own have 2"),
        Limit("toml_dots", 12, "parts of one dotted key in TOML", "time grows with their square; our own have 1"),
        Limit("digits", 100, "digits of one number in TOML or JSON", "a 64-bit float has 17 significant digits"),
        Limit("map_bytes", 64 * _MEBI, "bytes of a map image", "400 m by 400 m at 5 cm per pixel"),
        Limit("json_bytes", 4 * _MEBI, "bytes of a JSON text", "the largest result in the repository has 0.4 MB"),
        Limit("json_depth", 40, "nested brackets in JSON", "reports have 7"),
        Limit("offer_bytes", 64 * 1024, "bytes of an offered model, or of its margin", "all effects together: 3 KB"),
        Limit("offer_lines", 400, "lines of an offered model", "all effects of a car together: 110"),
        Limit("model_effects", 64, "effects of one model", "the largest library has 24"),
        Limit("model_free", 48, "free parameters of one model", "time grows with their square; all of a car: 30"),
        Limit("header_bytes", 64 * 1024, "bytes of the header of a CSV file", "4096 names of 15 characters"),
        Limit("columns", 4096, "columns of a table", "our widest log has 14"),
        Limit("table_bytes", 8192 * _MEBI, "bytes of a CSV or Parquet file", "a day at 100 Hz has 2 GB as text"),
        Limit(
            "piped_bytes", 1024 * _MEBI, "bytes from a pipe, or of a log without a known size", "half a day at 100 Hz"
        ),
        Limit("parquet_footer_bytes", 16 * _MEBI, "bytes of a Parquet footer", "about 100 per column and group"),
        Limit("expansion", 100, "expansion factor of a compressed file", "our recordings: 3 to 6"),
        Limit("expansion_free_bytes", 8 * _MEBI, "bytes to which any file may expand", "small files compress best"),
        Limit("reader_milliseconds", 800, "ms of processor time to read a file, plus 10 per KB", "most: 0.5 per KB"),
        Limit("reader_bytes", 160 * _MEBI, "bytes of memory to read a file, plus 30 per byte", "most: 12 per byte"),
        Limit("mcap_record_bytes", 32 * _MEBI, "bytes of one record in an MCAP file", "chunks of our own: 16 KB"),
        Limit("mcap_chunk_bytes", 16 * _MEBI, "bytes of an unpacked chunk in an MCAP file", "most writers: 1 to 4 MB"),
        Limit("mcap_channels", 65_535, "channels of an MCAP file", "channel numbers have 16 bits"),
        Limit("bag_bytes", 65536 * _MEBI, "bytes of a bag or a flight log", "a day with a camera; read in pieces"),
        Limit("bag_messages", 50_000_000, "messages of a bag that are kept", "a day at 100 Hz on five topics: 43e6"),
        Limit("bag_chunk_bytes", 64 * _MEBI, "bytes of one unpacked chunk in a ROS 1 bag", "rosbag writes 0.8 MB"),
        Limit("bag_topics", 4096, "topics of a bag or a flight log", "a large robot has 300"),
        Limit("bag_message_bytes", 64 * _MEBI, "bytes of one message in a bag", "an 8K image has 100 MB, 4K 25"),
        Limit("definition_letters", 64 * 1024, "characters of a message definition", "ROS: up to 30,000"),
        Limit("definition_lines", 1024, "lines and commas of a message definition", "the longest in ROS: 94"),
        Limit("definitions_lines", 3072, "lines and commas of all definitions listed", "all of ROS: 2214"),
        Limit("definitions_letters", 256 * 1024, "characters of all listed definitions", "50 types have 0.1 MB"),
        Limit("yaml_bytes", _MEBI, "bytes of a bag's metadata.yaml", "a topic takes 0.5 KB"),
        Limit("tensor_bytes", 256 * _MEBI, "bytes of a file of weights", "ours have 0.7 MB"),
        Limit("tensor_header_bytes", _MEBI, "bytes of the header of a file of weights", "ours have 7 KB"),
        Limit("tensors", 512, "tensors in a file of weights", "ours have 44"),
        Limit("tensor_name", 200, "characters of a tensor name", "ours have 18"),
        Limit("archive_members", 1024, "files in an archive", "ours have 2"),
        Limit("archive_bytes", 512 * _MEBI, "bytes of an unpacked archive", "saved drives have some MB"),
        Limit("message_entries", 256, "fields of one message", "the largest kind has 26"),
        Limit("upload_bytes", 512 * _MEBI, "bytes of one upload", "a day at 20 Hz has 0.4 GB as text"),
        Limit("uploads", 32, "uploads kept below one --out", "each stays on the disk for its session"),
        Limit("page_bytes", 64 * 1024, "bytes of one request to a page, except uploads", "a click has 1 KB"),
        Limit("socket_bytes", _MEBI, "bytes of one message to a page's socket", "a column map typed by hand has 4 KB"),
        Limit("name_letters", 200, "characters of a shown name or sentence", "longer ones are cut, with a note"),
    )
}


@lru_cache(maxsize=8)
def _settings(text: str) -> dict[str, int]:
    found = {}
    for part in filter(None, (item.strip() for item in text.split(","))):
        name, _, number = part.partition("=")
        if name not in TABLE or not (number.isascii() and number.isdecimal()) or not 0 < int(number[:19]) < 1 << 62:
            raise InputError(
                f"{VARIABLE}: got '{part[:80]}', wanted NAME=NUMBER with one of {', '.join(TABLE)} and a whole number "
                "above 0"
            )
        found[name] = int(number)
    return found


def limit(name: str) -> int:
    """The active limit: from the environment, else from the table. Raises InputError for an invalid setting."""
    return _settings(os.environ.get(VARIABLE, "")).get(name, TABLE[name].value)


def too_much(name: str, got: int | str, about: str = "") -> LimitError:
    """Returns the error that names the exceeded limit and how to raise it; ``about`` names the input."""
    entry = TABLE[name]
    where = f"{about}: " if about else ""
    return LimitError(
        f"{where}{entry.of}: got {got}, wanted at most {limit(name)}; if this is meant, set {VARIABLE}={name}=NUMBER"
    )
