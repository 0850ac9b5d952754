"""Files are put in place whole or not at all, and nothing that is no file is replaced."""

import json
import os
import stat
import subprocess
import sys
import threading

import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import (
    check_file,
    check_folder,
    file_sha256,
    folder_beside,
    missing_file,
    remove_written,
    write_text,
    written_whole,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def replace(folder, *files, error=None):
    with folder_beside(folder) as beside:
        for name in files:
            (beside / name).write_text("new")
        if error is not None:
            raise error


def test_after_an_error_every_file_is_as_it_was(tmp_path):
    write_text("old", tmp_path / "a")
    with pytest.raises(ZeroDivisionError):
        replace(tmp_path, "a", error=ZeroDivisionError())
    assert names(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "old"


@pytest.mark.parametrize("failing", range(1, 6))
def test_a_replacement_that_fails_half_way_is_undone(tmp_path, monkeypatch, failing):
    for name in "ac":
        write_text("old", tmp_path / name)
    move, calls = os.replace, []

    def fail_once(source, target):
        calls.append(source)
        if len(calls) == failing:
            raise KeyboardInterrupt
        move(source, target)

    monkeypatch.setattr(os, "replace", fail_once)
    with pytest.raises(KeyboardInterrupt):
        replace(tmp_path, *"abc")
    assert names(tmp_path) == ["a", "c"]
    assert [(tmp_path / name).read_text() for name in "ac"] == ["old", "old"]


def test_files_of_a_folder_replace_those_of_their_names(tmp_path):
    write_text("old", tmp_path / "a")
    (tmp_path / "other").write_text("kept")
    replace(tmp_path, "a", "b")
    assert names(tmp_path) == ["a", "b", "other"]
    assert (tmp_path / "a").read_text() == "new"


def test_a_folder_in_the_place_of_a_file_is_refused_and_nothing_is_mixed(tmp_path):
    write_text("old", tmp_path / "a")
    (tmp_path / "b").mkdir()
    message = r"b' is a folder, expected a file; remove it, or name another"
    with pytest.raises(SettingsError, match=message):
        replace(tmp_path, "a", "b")
    assert (tmp_path / "a").read_text() == "old"
    assert names(tmp_path) == ["a", "b"]
    with pytest.raises(SettingsError, match=message):
        check_folder(tmp_path, ["a", "b"])
    with pytest.raises(SettingsError, match=message):
        check_file(tmp_path / "b")


def test_only_files_that_robotid_wrote_are_replaced(tmp_path):
    """Not those of a user, nor those that a user changed; by another user, those of a result."""
    own, mine, result = tmp_path / "own.html", tmp_path / "log.csv", tmp_path / "result.json"
    write_text("1", own)
    write_text("2", own)
    mine.write_text("time\n")
    write_text(json.dumps({"robotid": "1", "outputs": {"report": "report.html"}}), result)
    write_text("page", tmp_path / "report.html")
    own.write_text("2 and a note")
    for path in (own, mine):
        before = path.read_text()
        for write in (lambda p: write_text("3", p), lambda p: replace(tmp_path, p.name)):
            with pytest.raises(SettingsError, match="robotid did not write it, or it has changed"):
                write(path)
        remove_written([path])
        assert path.read_text() == before
    with pytest.raises(SettingsError, match=r"result.json' is an input and is not replaced"):
        check_file(result, [tmp_path])
    os.utime(tmp_path / "report.html")  # a file of a result needs no mark
    replace(tmp_path, "report.html", "result.json")
    assert (tmp_path / "report.html").read_text() == "new"


def test_folders_that_are_not_writable_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda place, _: place != tmp_path)
    for check in (lambda: check_file(tmp_path / "a"), lambda: check_folder(tmp_path / "b", ["a"])):
        with pytest.raises(SettingsError, match=f"the folder '{tmp_path}' is not writable"):
            check()


def test_places_where_nothing_can_be_written_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SettingsError, match="file' is a file, expected a folder for the results"):
        check_folder(tmp_path / "file" / "below")
    check_folder(tmp_path / "not" / "yet", ["result.json"])
    with pytest.raises(DataError, match=r"the folder '.*not' of x does not exist"):
        write_text("", tmp_path / "not" / "x")


@pytest.mark.skipif(os.getuid() != 0, reason="only root makes device nodes")
def test_a_device_is_written_to_and_stays_a_device(tmp_path):
    node = tmp_path / "null"
    os.mknod(node, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    write_text("page", node)
    assert stat.S_ISCHR(node.stat().st_mode)
    assert names(tmp_path) == ["null"]


def test_a_pipe_gets_the_content_and_a_reader_that_leaves_is_named(tmp_path):
    pipe, heard = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: heard.append(pipe.read_text()))
    reader.start()
    write_text("page", pipe)
    reader.join()
    assert heard == ["page"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)

    def leave():
        with pipe.open() as stream:
            stream.read(1)

    reader = threading.Thread(target=leave)
    reader.start()
    with pytest.raises(DataError, match=r"the reader of '.*pipe' closed it before the end"):
        write_text("page" * 2**20, pipe)
    reader.join()


@pytest.mark.parametrize("name", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"])
def test_the_standard_output_is_written_to_whatever_it_is(tmp_path, name):
    code = f"from robotid.base.files import write_text; write_text('page', {name!r})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "page"
    with (tmp_path / "out").open("w") as file:
        inode = os.fstat(file.fileno()).st_ino
        subprocess.run([sys.executable, "-c", code], stdout=file, check=True)
    assert (tmp_path / "out").read_text() == "page"
    assert (tmp_path / "out").stat().st_ino == inode


def test_an_error_names_the_file_and_leaves_nothing(tmp_path):
    with pytest.raises(OSError, match="no space") as caught, written_whole(tmp_path / "x"):
        raise OSError(28, "no space")
    assert caught.value.__notes__ == [f"while writing {str(tmp_path / 'x')!r}"]
    assert names(tmp_path) == []


@pytest.mark.parametrize("name", ["x" * 255, "é" * 127, "x" * 223])
def test_a_file_whose_name_is_as_long_as_can_be_is_written(tmp_path, name):
    assert write_text("page", tmp_path / name).read_text() == "page"
    assert names(tmp_path) == [name]


def test_a_name_that_no_file_system_takes_is_refused_before_the_work(tmp_path):
    words = "has 256 bytes, expected at most 255; shorten it"
    for refuse in (
        lambda: check_file(tmp_path / ("x" * 256)),
        lambda: check_file(tmp_path / ("é" * 128)),
        lambda: check_folder(tmp_path, ["a", "x" * 256]),
        lambda: check_folder(tmp_path / "to make", ["a", "x" * 256]),
    ):
        with pytest.raises(SettingsError, match=words):
            refuse()


def test_what_has_no_end_has_no_hash(tmp_path):
    (tmp_path / "log.csv").symlink_to("/dev/null")
    with pytest.raises(DataError, match=r"log.csv' is a pipe or a device, expected a file; copy"):
        file_sha256(tmp_path / "log.csv")


def test_a_missing_file_is_answered_with_a_similar_one(tmp_path):
    (tmp_path / "Run_1.csv").touch()
    near = f". Did you mean {str(tmp_path / 'Run_1.csv')!r}?"
    for name in ("run_1.csv", "run1.csv", "Rum_1.cvs"):
        said = missing_file(tmp_path / name, "log file")
        assert said == f"there is no log file {str(tmp_path / name)!r}{near}"
    other = tmp_path / "friction.urdf"
    assert missing_file(other, "URDF file") == f"there is no URDF file {str(other)!r}"
    inside = tmp_path / "none" / "Run_1.csv"
    said = missing_file(inside, "log file")
    assert said.endswith(f"; there is no folder {str(tmp_path / 'none')!r}")
