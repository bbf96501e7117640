"""Files and folders in object storage, named by a URL such as ``s3://bucket/logs``, through fsspec.

A URL that went through ``Path`` has lost a slash; every function accepts it that way too. Endpoint and credentials
come from the environment, as each store defines it (``AWS_ENDPOINT_URL``, ``AWS_PROFILE``, ...).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

from safedpa.errors import MissingExtraError, RecordingError, RunError, SafedpaError
from safedpa.extras import need

__all__ = [
    "TransferError",
    "find_files",
    "matching",
    "open_store",
    "read_files",
    "remove",
    "url_of",
    "version_of",
    "write_file",
]

_URL = re.compile(r"(https?|s3|gs|gcs|az|abfss?|hdfs|s?ftp|hf|memory):/{1,2}([^/].*)")
"""A URL, also if ``Path`` removed one of its slashes."""
_PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs", "abfss": "adlfs"}
"""What fsspec needs for a store; the others need nothing, or their error names it."""
_AT_ONCE = 200
"""Files that are read at the same time: a request takes some 30 ms, whatever the size of a small file."""
_VERSIONS = ("ETag", "etag", "content_md5", "md5Hash", "LastModified", "updated", "created", "mtime")
"""Names under which a store reports what changes with the content of a file, the surest first."""


class TransferError(RunError):
    """A file that its store did not deliver; a later attempt may succeed."""


def url_of(path: str | Path) -> str:
    """Returns the URL that was given as a path; empty for the path of a local file.

    Example:

        >>> from pathlib import Path
        >>> url_of(Path("s3://bucket/logs"))
        's3://bucket/logs'
        >>> url_of("logs/run.csv")
        ''
    """
    found = _URL.fullmatch(str(path))
    return f"{found[1]}://{found[2]}" if found else ""


def open_store(url: str, *, remembers: bool = False) -> tuple[Any, str]:
    """Returns the fsspec file system of a URL and the place in it.

    With ``remembers`` it answers from listings that it made before, which others may have changed since.
    Raises MissingExtraError if fsspec or the package of that store is not installed.
    """
    url = url_of(url) or url
    need("remote", what=f"reading {url}")
    import fsspec

    try:
        store, place = fsspec.core.url_to_fs(url, use_listings_cache=remembers)
    except ImportError as error:
        package = _PACKAGES.get(url.partition(":")[0])
        how = f"pip install {package}" if package else " ".join(str(error).split())[:200]
        raise MissingExtraError(f"{url}: needs a package that is not installed: {how}") from error
    return store, str(place)


@contextmanager
def _transfer(url: str, what: str, failure: type[SafedpaError]) -> Iterator[None]:
    try:
        yield
    except SafedpaError:
        raise
    except Exception as error:  # each store raises its own kinds
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise failure(f"{url}: cannot be {what} ({reason}); check the address and the access rights") from error


def find_files(url: str, *, remembers: bool = False) -> list[str]:
    """Returns the URLs of all files below a folder, sorted. Raises TransferError if it cannot be listed.

    Names that no local folder could have (``..``, empty parts) are left out: they would leave a folder of results.
    """
    url = url_of(url) or url
    store, place = open_store(url, remembers=remembers)
    with _transfer(url, "listed", TransferError):
        store.invalidate_cache(place)
        names = store.find(place)
    base = place.rstrip("/")
    below = (name.removeprefix(base).lstrip("/") for name in names if name.startswith(f"{base}/"))
    return sorted(f"{url.rstrip('/')}/{name}" for name in below if all(_is_plain(part) for part in name.split("/")))


def matching(path: str | Path) -> list[str]:
    """Returns the URLs that match one with ``*``, sorted; any other path or URL alone.

    Raises TransferError without a match, or if the store cannot be asked.
    """
    url = url_of(path)
    if "*" not in url:
        return [url or str(path)]
    store, place = open_store(url)
    with _transfer(url, "listed", TransferError):
        names = store.glob(place)
        if not names:
            raise TransferError(f"{url}: matches no file; check the address")
        kind = url.partition(":")[0]
        return sorted(name if url_of(name) else f"{kind}://{name.lstrip('/')}" for name in names)


def _is_plain(part: str) -> bool:
    return part not in ("", ".", "..") and part.isprintable() and "\\" not in part


def version_of(url: str) -> dict[str, Any]:
    """Returns size and version of a file, as the store reports them. Raises OSError if it cannot be asked.

    After ``find_files(..., remembers=True)`` this asks the listing and not the store.
    """
    store, place = open_store(url, remembers=True)
    try:
        info = store.info(place)
    except Exception as error:
        raise OSError(f"{url}: {error}") from error
    version = next((str(info[name]) for name in _VERSIONS if info.get(name)), "")
    return {"path": url, "bytes": info.get("size"), "version": version.strip('"')}


def read_files(urls: Iterable[str]) -> Iterator[tuple[str, bytes | None]]:
    """Yields each URL of one store with the content of its file, None if there is none; some hundred at the same time.

    Raises TransferError if the store does not answer.
    """
    remaining = iter(urls)
    while group := list(islice(remaining, _AT_ONCE)):
        store, _ = open_store(group[0])
        places = {open_store(url)[1]: url for url in group}
        with _transfer(group[0], "read", TransferError):
            found = store.cat(list(places), on_error="return")
            found = found if isinstance(found, dict) else {next(iter(places)): found}
            for place, url in places.items():
                content = found.get(place)
                if isinstance(content, Exception) and not isinstance(content, FileNotFoundError):
                    raise content
                yield url, content if isinstance(content, bytes) else None


def write_file(url: str, content: bytes) -> None:
    """Writes a file; others see the old content or the new one. Raises RecordingError."""
    store, place = open_store(url)
    with _transfer(url, "written", RecordingError):
        store.pipe_file(place, content)


def remove(urls: Sequence[str]) -> None:
    """Removes files, those that exist. Raises RecordingError."""
    for url in urls:
        store, place = open_store(url)
        with _transfer(url, "removed", RecordingError), suppress(FileNotFoundError, KeyError):
            store.rm_file(place)
