"""Files: written to a temporary name and renamed when complete; identified by their hash."""

import difflib
import hashlib
import json
import logging
import math
import os
import re
import shutil
import tempfile
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from robotid.base.exceptions import DataError, SettingsError

_log = logging.getLogger(__name__)

#: The description of a LeRobot dataset, in its folder.
DATASET = Path("meta") / "info.json"
#: Bytes of a whole path, and characters of an attribute of a URDF, which may be a path.
LONGEST_PATH = 4095
#: Levels of tables and lists, and of nested elements of a URDF.
DEEPEST = 40
#: Files of results, which name the other files that were written with them.
_RECORDS = ("result.json", "track.json", "fleet.json")
_PAGES = ("report.html", "replay.html")  # beside a result
_MARKS = 10**6  # [ns] of a modification time that are a mark
_LONGEST = 255  # bytes of a file's name
_SHOWN = 60  # characters of a name in a message


def check_path(path: str | Path) -> None:
    """Refuse a path that no file system accepts."""
    try:
        raw = os.fsencode(path)
    except UnicodeEncodeError:
        raw = b"\0"
    if b"\0" in raw or len(raw) > LONGEST_PATH:
        raise SettingsError(
            f"{str(path)[:_SHOWN]!r} is not a valid path, expected UTF-8 without NUL, at most "
            f"{LONGEST_PATH} bytes"
        )
    name = max(raw.split(os.fsencode(os.sep)), key=len)
    if len(name) > _LONGEST:
        raise SettingsError(
            f"the name '{os.fsdecode(name)[:_SHOWN]}...' of a file has {len(name)} bytes, expected "
            f"at most {_LONGEST}; shorten it (names of results start with the URDF's name)"
        )


def check_file(target: Path, inputs: Iterable[str | Path | None] = ()) -> None:
    """Refuse a path where no file can be written, or with a file that robotid did not write."""
    check_path(target)
    if not target.parent.is_dir():
        raise DataError(
            f"the folder {str(target.parent)!r} of {target.name} does not exist; create it"
        )
    if target.is_dir():
        raise SettingsError(
            f"{str(target)!r} is a folder, expected a file; remove it, or name another file"
        )
    if _is_stream(target):
        return
    _require_writable(target.parent)
    is_hidden = any(part.startswith(".robotid-") for part in target.parts[:-1])  # finished units
    if not target.exists() or is_hidden:
        return
    named = [Path(path) for path in inputs if path]
    files = [*named, *(folder / name for folder in named for name in _RECORDS)]
    if any(path.exists() and target.samefile(path) for path in files):
        raise SettingsError(f"{str(target)!r} is an input and is not replaced; name another file")
    if not _is_written(target):
        raise SettingsError(
            f"{str(target)!r} exists, and robotid did not write it, or it has changed since; it is "
            "not replaced. Remove it, or name another file"
        )


def check_folder(
    target: Path, names: Iterable[str] = (), inputs: Iterable[str | Path | None] = ()
) -> None:
    """Refuse a folder where no results can be written, before the results are computed."""
    check_path(target)
    existing = next(folder for folder in (target, *target.absolute().parents) if folder.exists())
    if not existing.is_dir():
        raise SettingsError(
            f"{str(existing)!r} is a file, expected a folder for the results; name another folder"
        )
    _require_writable(existing)
    for name in names:
        check_path(name)
        if existing == target:
            check_file(target / name, inputs)


def remove_written(files: Iterable[Path]) -> None:
    """Remove files of an earlier run, with a warning; a file that robotid did not write stays."""
    for file in files:
        if file.is_file() and _is_written(file):
            _log.warning("removed %s of an earlier run: this run did not write it", file)
            file.unlink()


def _require_writable(folder: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise SettingsError(f"the folder {str(folder)!r} is not writable; name another folder")


def _is_written(path: Path) -> bool:
    """Return whether robotid wrote a file with this content, or a result beside it names it."""
    if path.stat().st_mtime_ns % _MARKS == _mark(path):
        return True
    for record in (path.with_name(name) for name in _RECORDS):
        try:
            content = json.loads(record.read_bytes())
        except (OSError, ValueError):  # no result
            continue
        if isinstance(content, dict) and "robotid" in content:
            outputs = content.get("outputs", {})
            named = outputs.values() if isinstance(outputs, dict) else ()
            if path == record or path.name in (*named, *_PAGES):
                return True
    return False


def _mark(path: Path) -> int:
    """Return the last digits of the time of a file that robotid wrote: a hash of its content."""
    return 100 * (int(file_sha256(path)[:12], 16) % (_MARKS // 100))


def _marked(path: Path) -> None:
    """Mark a file as written by robotid, so that a later run may replace it."""
    times = path.stat()
    written = times.st_mtime_ns // _MARKS * _MARKS + _mark(path)
    os.utime(path, ns=(times.st_atime_ns, written))


@contextmanager
def written_whole(target: str | Path) -> Iterator[Path]:
    """Provide a hidden name beside a file; what is written there then replaces the file, or not."""
    path = Path(target)
    check_file(path)
    if _is_stream(path):  # it receives the content when that is complete
        with tempfile.TemporaryDirectory(prefix="robotid-") as folder:
            yield Path(folder, path.name)
            try:
                with Path(folder, path.name).open("rb") as made, path.open("wb") as stream:
                    shutil.copyfileobj(made, stream)
            except BrokenPipeError as error:
                raise DataError(f"the reader of {str(path)!r} closed it before the end") from error
        return
    name = hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]  # short, also of a long name
    hidden = path.with_name(f".{name}.{os.getpid()}")
    try:
        yield hidden
        _marked(hidden)
        os.replace(hidden, path)
    except OSError as error:  # most messages do not name the file
        error.add_note(f"while writing {str(path)!r}")
        raise
    finally:
        hidden.unlink(missing_ok=True)


def _is_stream(path: Path) -> bool:
    """Return whether a path is a device or a pipe, which must not be replaced."""
    is_special = path.exists() and not path.is_file()
    shown = path.absolute().parts[1:2]  # /dev/stdout, /dev/fd/1, /proc/self/fd/1
    return is_special or (path.is_symlink() and shown in (("dev",), ("proc",)))


@contextmanager
def folder_beside(target: Path) -> Iterator[Path]:
    """Provide a hidden folder in a folder; its files are then moved there, or none of them."""
    with tempfile.TemporaryDirectory(prefix=".robotid-", dir=target) as hidden:
        new, old = Path(hidden, "new"), Path(hidden, "old")
        new.mkdir()
        old.mkdir()
        yield new
        names = sorted(made.name for made in new.iterdir())
        check_folder(target, names)
        try:
            for name in names:
                if os.path.lexists(target / name):
                    os.replace(target / name, old / name)
                os.replace(new / name, target / name)
        except BaseException:
            for name in names:
                if os.path.lexists(old / name):
                    os.replace(old / name, target / name)
                elif not os.path.lexists(new / name):
                    (target / name).unlink()
            raise
        for name in names:
            _marked(target / name)


def write_text(text: str, target: str | Path) -> Path:
    """Write a text file completely or not at all, and return its path."""
    path = Path(target)
    with written_whole(path) as hidden:
        hidden.write_text(text, encoding="utf-8")
    return path


def write_json(content: Mapping[str, Any], target: str | Path) -> None:
    """Write a JSON file completely or not at all."""
    write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", target)


def finite(value: float) -> float | None:
    """Return a number for JSON: None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file, which errors describe as ``what``."""
    check_path(path)
    if not path.is_file():
        raise SettingsError(missing_file(path, what))
    try:
        return tomllib.loads(text := path.read_text(encoding="utf-8-sig"))
    except tomllib.TOMLDecodeError as error:
        at = re.search(r"at line (\d+)", str(error))
        line = ": " + text.split("\n")[int(at[1]) - 1].strip()[:80] if at else ""
        raise SettingsError(
            f"{path.name} is not valid TOML: {error}{line}. Text and paths need quotes; a key or "
            "[table] occurs once"
        ) from error
    except (ValueError, RecursionError) as error:  # not UTF-8, numbers too long, tables too deep
        raise SettingsError(f"{path.name} is not valid TOML: {error}") from error


def missing_file(path: Path, what: str) -> str:
    """Return the message for a path that is not a regular file."""
    if path.is_dir():
        return f"{str(path)!r} is a folder, expected a {what}"
    if path.exists():
        return f"{str(path)!r} is a pipe or a device, expected a {what}; copy it to a file"
    return f"there is no {what} {str(path)!r}{_similar_file(path)}"


def _similar_file(path: Path) -> str:
    """Return which part of a missing path does not exist, or which existing file is similar."""
    folder = path.parent
    if not folder.is_dir():
        return f"; there is no folder {str(folder)!r}"
    try:
        by_name = {file.name.lower(): file.name for file in folder.iterdir()}
    except OSError:  # not readable
        return ""
    near = difflib.get_close_matches(path.name.lower(), by_name, n=1, cutoff=0.75)
    return f". Did you mean {str(path.with_name(by_name[near[0]]))!r}?" if near else ""


def read_json(path: str | Path, what: str) -> Any:  # noqa: ANN401
    """Return the content of a JSON file with finite numbers, valid Unicode and few levels."""
    source = Path(path)
    if not source.is_file():
        raise DataError(missing_file(source, what))
    try:
        content = json.loads(source.read_text(encoding="utf-8"))
        json.dumps(content, allow_nan=False, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{source.name} is not JSON: {str(error)[:200]}; expected a {what}"
        ) from error
    inside = [content]
    for _ in range(DEEPEST):
        lists = [
            x.values() if isinstance(x, dict) else x for x in inside if isinstance(x, dict | list)
        ]
        inside = [x for entries in lists for x in entries]
    if inside:
        raise DataError(f"{source.name} has more than {DEEPEST} levels: it is not a {what}")
    return content


def dataset_of(path: Path) -> Path | None:
    """Return the folder of the LeRobot dataset that a path as ``dataset/episode_3`` names."""
    is_episode = re.fullmatch(r"episode_[0-9]+", path.name) and not path.exists()
    return path.parent if is_episode and (path.parent / DATASET).is_file() else None


def log_exists(path: Path) -> bool:
    """Return whether a log exists: a file, a folder, or a dataset of which it is an episode."""
    return path.exists() or dataset_of(path) is not None


def file_sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; of a folder, that of its files' hashes."""
    source = Path(path)
    if source.exists() and not source.is_file() and not source.is_dir():
        raise DataError(missing_file(source, "file"))
    listing = ""  # as of sha256sum
    if (dataset := dataset_of(source)) is not None:
        listing = f"{file_sha256(dataset)}  {source.name}\n"
    elif source.is_dir():
        files = sorted(file for file in source.rglob("*") if file.is_file())
        names = [file.relative_to(source).as_posix() for file in files]
        both = zip(files, names, strict=True)
        listing = "".join(f"{file_sha256(file)}  {name}\n" for file, name in both)
    if listing or source.is_dir():
        return hashlib.sha256(listing.encode()).hexdigest()
    about = source.stat()
    return _sha256(source.resolve(), about.st_size, about.st_mtime_ns, about.st_ino)


def moved_file(path: Path, result: Path, hashes: Collection[str]) -> Path:
    """Return an input of a result, also if the folder that has both was moved or renamed."""
    try:
        check_path(path)
    except SettingsError:  # reported where it is read
        return path
    if log_exists(path):
        return path
    for folder in result.resolve().parents:
        for k in range(len(path.parts)):
            place = folder.joinpath(*path.parts[k:])
            if log_exists(place) and file_sha256(place) in hashes:
                return place
    return path


@lru_cache(maxsize=1024)
def _sha256(path: Path, *_state: int) -> str:
    """Return the SHA-256 of a file; it is read again only if its state has changed."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def source_entry(path: str) -> dict[str, Any]:
    """Return the path of an input and the hash of its file, None for an input in memory."""
    is_file = bool(path) and log_exists(Path(path))
    return {"path": str(path), "sha256": file_sha256(path) if is_file else None}
