"""What is kept of a model's versions is on the disk before its name is given, so that a power failure loses nothing."""

import os
from pathlib import Path

from safedpa.live.versions import ModelVersion, PersistedState, VersionFolder


def test_each_file_is_whole_on_the_disk_before_it_takes_its_name_and_then_its_name_is(tmp_path, monkeypatch):
    order = list[tuple[str, str, int]]()
    sync, put = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        order.append(("synced", path.name, 0 if path.is_dir() else os.fstat(descriptor).st_size))
        sync(descriptor)

    def placed(source: Path, target: Path) -> None:
        order.append(("placed", target.name, source.stat().st_size))
        put(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", placed)
    VersionFolder(tmp_path).save(PersistedState((ModelVersion("print", "a model's text", "a margin's text"),)))
    names = ["model-000-print.toml", "model-000-print.margin.json", "changes.json"]
    sizes = [(tmp_path / name).stat().st_size for name in names]
    assert sizes[0] == len("a model's text")
    assert order == [
        step
        for name, size in zip(names, sizes, strict=True)
        for step in (("synced", f"{name}.new", size), ("placed", name, size), ("synced", tmp_path.name, 0))
    ]
