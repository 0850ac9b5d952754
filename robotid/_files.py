"""Files: written beside their target and put in place whole; known by their hash."""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from robotid.exceptions import DataError

__all__ = ["file_sha256", "folder_beside", "write_json", "write_text", "written_whole"]


@contextmanager
def written_whole(target: str | Path) -> Iterator[Path]:
    """Give a hidden name beside a file; what is written there is then put in its place.

    After an error the target is as it was, and nothing is left beside it.

    Args:
        target: The file.

    Yields:
        Where to write.
    """
    path = Path(target)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield beside
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


@contextmanager
def folder_beside(target: Path) -> Iterator[Path]:
    """Give a hidden folder in a folder; the files made there are then put in place, by name.

    After an error none of them is, and the hidden folder is gone.

    Args:
        target: The folder; it must exist.

    Yields:
        Where to write.
    """
    beside = Path(tempfile.mkdtemp(prefix=".robotid-", dir=target))
    try:
        yield beside
        for made in sorted(beside.iterdir()):
            os.replace(made, target / made.name)
    finally:
        shutil.rmtree(beside)


def write_text(text: str, target: str | Path) -> Path:
    """Write a page, whole or not at all, and return its path.

    Args:
        text: Its content.
        target: The file.

    Raises:
        DataError: If its folder does not exist.
    """
    path = Path(target)
    if not path.parent.is_dir():
        raise DataError(f"there is no folder {str(path.parent)!r} to write {path.name} in")
    with written_whole(path) as beside:
        beside.write_text(text, encoding="utf-8")
    return path


def write_json(content: Mapping[str, Any], target: str | Path) -> None:
    """Write JSON, whole or not at all.

    Args:
        content: What to write; non-finite numbers are refused.
        target: The file.

    Raises:
        DataError: If its folder does not exist.
    """
    write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", target)


def file_sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; of a folder, that of its files' hashes.

    Args:
        path: The file, or the folder of a bag.
    """
    source = Path(path)
    if source.is_dir():
        files = sorted(file for file in source.iterdir() if file.is_file())
        listing = "".join(f"{file_sha256(file)}  {file.name}\n" for file in files)  # as sha256sum
        return hashlib.sha256(listing.encode()).hexdigest()
    about = source.stat()
    return _sha256(source.resolve(), about.st_size, about.st_mtime_ns, about.st_ino)


@lru_cache(maxsize=1024)
def _sha256(path: Path, *_state: int) -> str:
    """Return the SHA-256 of a file, which is read once as long as its state is the same."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
