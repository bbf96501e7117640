"""A fleet's logs and results in object storage, by URL. The store here is fsspec's in memory, in one process."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

fsspec = pytest.importorskip("fsspec")

from safedpa.errors import InputError, MissingExtraError, RunError  # noqa: E402
from safedpa.fleet import Fleet, Options, diagnose_fleet, robots_in_folder, robots_of_files  # noqa: E402
from safedpa.records.store import TransferError, find_files, matching, read_files, remove, write_file  # noqa: E402
from safedpa_services.command_line.group import safedpa  # noqa: E402

LOGS, OUT = Path("memory://fleet/logs"), Path("memory://fleet/out")
TOO_SHORT = b"t,x,y,yaw,speed,target_speed,steer\n" + b"".join(b"%.2f,0,0,0,1,1,0\n" % (0.05 * i) for i in range(9))


@pytest.fixture(autouse=True)
def store() -> Iterator[None]:
    files = fsspec.filesystem("memory")
    files.store.clear()
    yield
    files.store.clear()


def stored(*names: str, content: bytes = TOO_SHORT) -> None:
    for name in names:
        write_file(f"memory://fleet/logs/{name}", content)


def here(work, jobs, _failed):
    yield from map(work, jobs)


def diagnosed(**more) -> dict:
    return diagnose_fleet(Fleet(robots_in_folder(LOGS), Options("car"), OUT), here, **more)


def test_each_folder_below_a_url_is_a_robot_and_hidden_files_and_results_are_left_out() -> None:
    stored("r1/a.csv", "r1/deep/b.csv", "r2/a.parquet", "r2/.hidden.csv", ".git/x.csv", "r1/notes.txt", "loose.csv")
    stored("out/fleet.json", "out/recordings/r9.mcap")
    found = robots_in_folder(LOGS)
    assert {robot.name: [path.name for path in robot.files] for robot in found.robots} == {
        "r1": ["a.csv", "b.csv"], "r2": ["a.parquet"],
    }  # fmt: skip
    assert [path.name for path, _ in found.left_out] == ["loose.csv"]


def test_names_that_would_leave_the_folder_of_results_are_no_robots() -> None:
    stored("../../evil/a.csv", "r1//a.csv", "r2/../../x.csv", "a\\b/a.csv", "line\nbreak/a.csv", "good/a.csv")
    assert [robot.name for robot in robots_in_folder(LOGS).robots] == ["good"]


def test_runs_by_url_are_grouped_like_files_and_stores_are_not_mixed(tmp_path: Path) -> None:
    paths = [Path(f"memory://fleet/logs/{name}/a.csv") for name in ("r1", "r2")]
    assert [robot.name for robot in robots_of_files(paths).robots] == ["r1", "r2"]
    with pytest.raises(InputError, match="several stores"):
        robots_of_files([*paths, tmp_path / "a.csv"])


def test_results_in_a_store_resume_and_change_with_the_logs() -> None:
    stored("r1/a.csv", "r2/a.csv")
    assert diagnosed()["diagnosed_now"] == 2
    assert {name.rpartition("/")[2] for name in find_files(str(OUT))} >= {"fleet.json", "fleet.html", "result.json"}
    assert diagnosed()["diagnosed_now"] == 0
    stored("r1/a.csv", content=TOO_SHORT + b"0.45,0,0,0,1,1,0\n")
    assert diagnosed()["diagnosed_now"] == 1
    assert diagnosed(again=True)["diagnosed_now"] == 2


def test_a_robot_that_left_the_fleet_loses_its_result_and_other_files_stay() -> None:
    stored("r1/a.csv", "r2/a.csv")
    diagnosed()
    write_file("memory://fleet/out/robots/mine/notes.txt", b"of the user")
    remove(["memory://fleet/logs/r2/a.csv"])
    assert [robot["robot"] for robot in diagnosed()["robots"]] == ["r1"]
    robots = {name.split("/")[-2] for name in find_files("memory://fleet/out/robots")}
    assert robots == {"r1", "mine"}


def test_a_worker_that_died_while_writing_leaves_no_result() -> None:
    stored("r1/a.csv")
    diagnosed()
    remove(["memory://fleet/out/robots/r1/result.json"])
    assert diagnosed()["diagnosed_now"] == 1


def test_an_unreadable_log_costs_itself_and_one_that_did_not_arrive_is_tried_again(monkeypatch) -> None:
    stored("r1/a.csv", "r2/a.csv")
    stored("r2/b.csv", content=b"no table\n1\n")
    found = {robot["robot"]: robot["unreadable_files"] for robot in diagnosed()["robots"]}
    assert found == {"r1": 0, "r2": 1}
    assert diagnosed()["diagnosed_now"] == 0
    stored("r3/a.csv")

    memory = type(fsspec.filesystem("memory"))
    usual = memory.open

    def broken(store: Any, path: str, mode: str = "rb", **more: Any) -> Any:
        if mode == "rb" and path.endswith("r3/a.csv"):
            raise ConnectionError("the store is away")
        return usual(store, path, mode, **more)

    with monkeypatch.context() as patch:
        patch.setattr(memory, "open", broken)
        assert diagnosed()["diagnosed_now"] == 1
    assert diagnosed()["diagnosed_now"] == 1


def test_missing_files_are_none_and_other_failures_of_the_store_are_one_line(monkeypatch) -> None:
    stored("r1/a.csv")
    urls = [f"{LOGS}/r1/a.csv".replace(":/", "://"), "memory://fleet/none"]
    assert [content is None for _, content in read_files(urls)] == [False, True]

    def broken(*_: object, **__: object) -> None:
        raise PermissionError("no\nrights")

    monkeypatch.setattr(type(fsspec.filesystem("memory")), "cat_file", broken)
    with pytest.raises(TransferError, match=r"cannot be read \(no rights\)"):
        list(read_files(urls))


def test_an_empty_or_unknown_folder_and_the_folder_of_the_logs_as_output_are_refused(capsys) -> None:
    with pytest.raises((InputError, RunError), match="memory:/"):
        robots_in_folder(LOGS)
    stored("r1/a.csv")
    assert safedpa.run(["diagnose", "car", "--fleet", str(LOGS), "--out", "memory://fleet/logs"]) == 2
    assert "choose another folder" in capsys.readouterr().err


def test_a_store_whose_package_is_missing_is_one_line(monkeypatch) -> None:
    def missing(_url: str, **_: object) -> None:
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(fsspec.core, "url_to_fs", missing)
    with pytest.raises(MissingExtraError, match=r"^s3://bucket/logs: needs a package .*: pip install s3fs$"):
        find_files("s3://bucket/logs")


def test_recordings_of_many_robots_are_split_once_into_the_store(tmp_path: Path) -> None:
    from tests.fleet_diagnosis.test_diagnosed_again import record

    write_file("memory://fleet/logs/many.mcap", record(tmp_path / "many.mcap", ("one", "two"), 20).read_bytes())
    document = diagnosed()
    assert [robot["robot"] for robot in document["robots"]] == ["one", "two"]
    pieces = [name for name in find_files(str(OUT)) if name.endswith(".mcap")]
    assert sorted(Path(name).stem for name in pieces) == ["one", "two"]
    assert diagnosed()["diagnosed_now"] == 0
    ((_, content),) = read_files(["memory://fleet/out/fleet.json"])
    assert content is not None
    assert json.loads(content)["by"] == "robot"


def test_runs_match_a_url_with_a_star_and_a_recording_by_url_is_replayed(tmp_path: Path, capsys: Any) -> None:
    stored("r1/a.csv", "r1/b.csv")
    assert matching("memory://fleet/logs/r1/*.csv") == [f"memory://fleet/logs/r1/{name}.csv" for name in "ab"]
    assert matching(tmp_path / "*.csv") == [str(tmp_path / "*.csv")]
    with pytest.raises(TransferError, match="matches no file"):
        matching("memory://fleet/none/*")
    write_file("memory://fleet/damaged.mcap", b"no recording")
    assert safedpa.run(["replay", "memory://fleet/damaged.mcap"]) == 2
    assert "no such file" not in capsys.readouterr().err
