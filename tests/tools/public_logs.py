"""Tries the readers on the sample files of public repositories: each is read, or refused in one line.

    python tests/tools/public_logs.py FOLDER...

Clone the repositories of ``REPOSITORIES`` below a folder first, as ``git clone --depth 1 https://github.com/NAME``; a
folder may also be a bare repository. Prints a line for each file that is neither, and exits with 1 if there is one.
"""

import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from safedpa.errors import SafedpaError
from safedpa.records import load_column_map, load_run
from safedpa.records.readers.preview import raw_rows
from safedpa.robots.car.system import CAR

REPOSITORIES = ("PX4/pyulog", "ros2/rosbag2", "foxglove/mcap", "facontidavide/PlotJuggler")
SUFFIXES = (".ulg", ".db3", ".mcap", ".bag", ".csv", ".zstd", ".parquet", ".npz", ".mat")


def files_in(folder: Path, target: Path) -> list[Path]:
    """Sample files below a folder; those of a bare repository are written to ``target``."""
    if not (folder / "HEAD").is_file():
        return [path for path in sorted(folder.rglob("*")) if path.name.endswith(SUFFIXES) and path.is_file()]
    git = ["git", "--git-dir", str(folder)]
    names = subprocess.run([*git, "ls-tree", "-rz", "--name-only", "HEAD"], capture_output=True, check=True).stdout
    found = []
    for name in names.decode().split("\0"):
        if name.endswith(SUFFIXES):
            path = target / folder.parent.name / name
            path.parent.mkdir(parents=True, exist_ok=True)
            shown = subprocess.run([*git, "show", f"HEAD:{name}"], capture_output=True, check=False)
            path.write_bytes(shown.stdout)
            found.append(path)
    return found


def tried(path: Path) -> str:
    """How a file was read: ``read``, ``pointer`` (its content is kept elsewhere), ``refused``, or what is wrong."""
    if path.read_bytes()[:100].startswith(b"version https://git-lfs"):
        return "pointer"
    result = "refused"
    for read in (
        raw_rows,
        lambda file: load_run(file, CAR),
        lambda file: load_run(file, CAR, load_column_map("f1tenth_bag")),
    ):
        began = time.monotonic()
        try:
            read(path)
            result = "read"
        except SafedpaError as error:
            if "\n" in str(error) or len(str(error)) > 2000:
                return f"got a long message: {str(error)[:300]!r}"
        except Exception as error:  # noqa: BLE001  this is what is looked for
            return f"got {type(error).__name__}: {error}"
        if time.monotonic() - began > 60.0:
            return "took more than 60 s"
    return result


def main() -> int:
    """Prints the counts of each repository."""
    failed = False
    with tempfile.TemporaryDirectory() as target:
        for folder in map(Path, sys.argv[1:]):
            counts: Counter[str] = Counter()
            for path in files_in(folder, Path(target)):
                result = tried(path)
                counts[result if result in ("read", "refused", "pointer") else "failed"] += 1
                if counts["failed"] and result not in ("read", "refused", "pointer"):
                    print(f"{path}: {result}")
                    failed = True
            print(f"{folder}: {dict(counts)}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
