"""What an installation takes: ``python deploy/install_size.py [--extra sim] [--source FOLDER] [--keep FOLDER]``.

Builds the wheel of a working tree, installs it into an empty environment, and prints seconds and MB (10^6 bytes on
disk) of the whole and of the largest packages. ``--without scipy`` takes a package away again afterwards;
``--requirement deploy/filter-only.txt`` installs the packages of a file without their dependencies.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LARGEST = 6
"""Packages that are printed."""


def size_of(folder: Path) -> float:
    """MB of the regular files under a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink()) / 1e6


def installed(source: Path, extras: str, into: Path, requirement: Path | None = None) -> float:
    """Installs the tree with its extras, or with what the file names, into a new environment.

    Returns the seconds from the first package looked up on.
    """
    subprocess.run([sys.executable, "-m", "venv", str(into)], check=True)
    pip = [str(into / "bin" / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check"]
    wheels = into / "wheels"
    plain = {**os.environ, "SAFEDPA_COMPILE": "0"}
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", str(wheels), str(source)], check=True, env=plain)
    (wheel,) = wheels.glob("safedpa-*.whl")
    begun = time.monotonic()
    wanted = [f"{wheel}[{extras}]" if extras else str(wheel)]
    wanted += ["--no-deps", "--requirement", str(requirement)] if requirement else []
    subprocess.run([*pip, "install", "--constraint", str(source / "constraints.txt"), *wanted], check=True)
    return time.monotonic() - begun


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--extra", action="append", default=[], help="repeatable; without: the core alone")
    parser.add_argument("--source", type=Path, default=ROOT, help="another working tree, an earlier version say")
    parser.add_argument("--without", action="append", default=[], metavar="PACKAGE", help="uninstall it afterwards")
    parser.add_argument("--requirement", type=Path, metavar="FILE", help="install these packages alone")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="safedpa-install-") as name:
        into = Path(name) / "environment"
        seconds = installed(options.source, ",".join(options.extra), into, options.requirement)
        for package in options.without:
            subprocess.run([into / "bin" / "python", "-m", "pip", "-q", "uninstall", "--yes", package], check=True)
        (packages,) = (into / "lib").glob("python3.*/site-packages")
        own = [path for path in packages.iterdir() if path.is_dir() and path.name not in ("pip", "setuptools")]
        sizes = sorted(((size_of(path), path.name) for path in own), reverse=True)
        sys.stdout.write(f"{seconds:.0f} s, {sum(size for size, _ in sizes):.0f} MB next to pip; largest:\n")
        for size, folder in sizes[:LARGEST]:
            sys.stdout.write(f"  {folder:28}{size:8.0f} MB\n")


if __name__ == "__main__":
    main()
