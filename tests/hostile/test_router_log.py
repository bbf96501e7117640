"""The router's log never makes the router wait, however little of it is read."""

import os
import stat

from safedpa_services.router.refusals import LogFile


def test_lines_come_whole_and_in_order() -> None:
    file = LogFile()
    os.write(file.descriptor, b"one\ntw")
    assert file.lines() == ["one"]
    os.write(file.descriptor, b"o\nthree\n")
    assert file.lines() == ["two", "three"]
    assert file.lines() == []
    assert file.skipped == 0
    os.close(file.descriptor)


def test_an_unread_flood_never_blocks_the_writer_and_is_given_back() -> None:
    file, line = LogFile(most_unread=1 << 20), b"x" * 1023 + b"\n"
    assert stat.S_ISREG(os.fstat(file.descriptor).st_mode), "who writes to a full pipe or socket waits"
    for _ in range(20_000):
        assert os.write(file.descriptor, line) == len(line), "no error, of which the logger would tell, waiting"
    assert file.lines() == []
    assert file.skipped == 20_000 * len(line)
    os.write(file.descriptor, b"after it\n")
    assert file.lines() == ["after it"]
    assert os.fstat(file.descriptor).st_blocks * 512 < 1 << 20
    os.close(file.descriptor)


def test_a_line_without_an_end_is_cut_at_its_longest_length() -> None:
    file = LogFile()
    for _ in range(3):
        os.write(file.descriptor, b"x" * 60_000)
        assert file.lines() == []
    os.write(file.descriptor, b"\n")
    (line,) = file.lines()
    assert len(line) == 1 << 16
    os.close(file.descriptor)
