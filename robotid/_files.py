"""Files: written beside their target and put in place whole; known by their hash."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["file_sha256", "write_json"]


def write_json(content: Mapping[str, Any], target: str | Path) -> None:
    """Write JSON beside its target, then put it in place.

    Args:
        content: What to write; non-finite numbers are refused.
        target: The file.
    """
    path = Path(target)
    text = json.dumps(content, indent=1, allow_nan=False)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_text(text + "\n", encoding="utf-8")
    os.replace(beside, path)


def file_sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; of a folder, that of its files' hashes.

    Args:
        path: The file, or the folder of a bag.

    Returns:
        64 hexadecimal digits.
    """
    source = Path(path)
    if source.is_dir():
        files = sorted(file for file in source.iterdir() if file.is_file())
        listing = "".join(f"{file_sha256(file)}  {file.name}\n" for file in files)  # as sha256sum
        return hashlib.sha256(listing.encode()).hexdigest()
    with source.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
