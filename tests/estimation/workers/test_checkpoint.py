"""Finished pieces are kept whole, found again by name, and never used for other inputs."""

import logging
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
from helpers.piecework import marks, open_checkpoint, pieces_in, reduce_all, same_bits

from robotid.base.exceptions import DataError
from robotid.estimation.workers.checkpoint import FOLDER, released_on_error

INPUTS = {"robotid": "0.1", "signals": {"cutoff": 8.0, "order": 4}, "logs": [{"size": 10}]}


def interrupted(tmp_path, count=6, after=3):
    """Return pieces of which the first few are in a checkpoint."""
    pieces = pieces_in(tmp_path / "marks", count)
    checkpoint = open_checkpoint(tmp_path, INPUTS, pieces)
    for k, reduction in enumerate(reduce_all(pieces[:after])):
        checkpoint.save(k, pieces[k].name, reduction)
    return pieces


def test_only_missing_pieces_are_reduced_and_progress_starts_where_it_stood(tmp_path):
    pieces = interrupted(tmp_path)
    calls = []
    checkpoint = open_checkpoint(tmp_path, INPUTS, pieces, resume=True)
    found = reduce_all(pieces, checkpoint=checkpoint, progress=lambda *call: calls.append(call[1]))
    assert calls == [303, 406, 510, 615]
    assert marks(tmp_path / "marks") == dict.fromkeys(range(6), 1)
    assert all(map(same_bits, found, reduce_all(pieces_in(tmp_path / "other", 6))))
    checkpoint.remove()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["marks", "other"]


@pytest.mark.parametrize(
    ("inputs", "words"),
    [
        (INPUTS | {"signals": {"cutoff": 6.0, "order": 4}}, "signals.cutoff was 8.0, is 6.0"),
        (INPUTS | {"logs": [{"size": 11}]}, r"logs\[0\].size was 10, is 11"),
        (INPUTS | {"robotid": "0.2"}, "robotid was '0.1', is '0.2'"),
        (INPUTS | {"gravity": 9.8}, "gravity was None, is 9.8"),
    ],
)
def test_a_checkpoint_of_other_inputs_is_refused_by_name(tmp_path, inputs, words):
    pieces = interrupted(tmp_path)
    with pytest.raises(DataError, match=words) as caught:
        open_checkpoint(tmp_path, inputs, pieces, resume=True)
    assert "run without --resume" in str(caught.value)
    assert len(open_checkpoint(tmp_path, INPUTS, pieces, resume=True).finished()) == 3


def test_other_pieces_are_other_inputs(tmp_path):
    pieces = interrupted(tmp_path)
    with pytest.raises(DataError, match="checkpoint of other inputs: pieces was"):
        open_checkpoint(tmp_path, INPUTS, pieces[:-1], resume=True)


def test_a_file_of_another_run_is_refused(tmp_path):
    pieces = interrupted(tmp_path)
    other = open_checkpoint(tmp_path / "elsewhere", INPUTS | {"x": 1}, pieces)
    other.save(4, pieces[4].name, reduce_all(pieces[4:5])[0])
    (other.folder / "piece-000004.npz").rename(
        tmp_path / ".robotid-checkpoint" / "piece-000004.npz"
    )
    checkpoint = open_checkpoint(tmp_path, INPUTS, pieces, resume=True)
    with pytest.raises(
        DataError, match=r"piece-000004.npz is of a run with other inputs. Delete it"
    ):
        reduce_all(pieces, checkpoint=checkpoint)


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_a_damaged_file_is_refused_by_name(tmp_path, damage):
    pieces = interrupted(tmp_path)
    path = tmp_path / ".robotid-checkpoint" / "piece-000001.npz"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content if damage == "flip" else content[: len(content) // 2])
    checkpoint = open_checkpoint(tmp_path, INPUTS, pieces, resume=True)
    with pytest.raises(DataError, match=r"piece-000001.npz cannot be read .* Delete it"):
        reduce_all(pieces, checkpoint=checkpoint)


def test_half_a_file_is_never_taken_for_a_piece(tmp_path):
    pieces = interrupted(tmp_path)
    folder = tmp_path / ".robotid-checkpoint"
    (folder / ".piece-000005.npz.321").write_bytes(b"PK")
    assert sorted(open_checkpoint(tmp_path, INPUTS, pieces, resume=True).finished()) == [0, 1, 2]


def test_without_resume_an_unfinished_run_is_replaced_and_that_is_said(tmp_path, caplog):
    pieces = interrupted(tmp_path)
    with caplog.at_level(logging.WARNING):
        checkpoint = open_checkpoint(tmp_path, INPUTS, pieces)
    assert "has an unfinished run. It is replaced" in caplog.text
    assert checkpoint.finished() == frozenset()
    assert [path.name for path in checkpoint.folder.iterdir()] == ["inputs.json"]


def test_nothing_to_resume_is_said(tmp_path, caplog):
    pieces = pieces_in(tmp_path / "marks", 2)
    with caplog.at_level(logging.WARNING):
        open_checkpoint(tmp_path / "new", INPUTS, pieces, resume=True)
    assert "no run to resume, a new one starts" in caplog.text


def test_a_kept_piece_has_the_same_bits(tmp_path):
    pieces = interrupted(tmp_path)
    kept = open_checkpoint(tmp_path, INPUTS, pieces, resume=True)
    fresh = reduce_all(pieces[:3])
    assert all(same_bits(kept.load(k), fresh[k]) for k in range(3))


@pytest.mark.parametrize("resume", [False, True])
def test_a_checkpoint_that_another_run_works_in_is_refused_and_left_as_it_is(tmp_path, resume):
    pieces = pieces_in(tmp_path / "marks", 3)
    first = open_checkpoint(tmp_path, INPUTS, pieces)
    first.save(1, pieces[1].name, reduce_all(pieces[1:2])[0])
    with pytest.raises(
        DataError, match=r"another run is using the checkpoint .*checkpoint. Wait for"
    ):
        open_checkpoint(tmp_path, INPUTS, pieces, resume=resume)
    assert first.finished() == {1}
    first.release()
    assert open_checkpoint(tmp_path, INPUTS, pieces, resume=True).finished() == {1}


def test_a_process_that_ended_in_any_way_locks_nothing(tmp_path):
    code = (
        "import os, sys; from robotid.estimation.workers.checkpoint import Checkpoint; "
        "kept = Checkpoint.open(sys.argv[1], {}, [], None); print(kept.folder); "
        "os.kill(os.getpid(), 9)"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert ended.returncode == -9
    assert open_checkpoint(tmp_path, {}, [], resume=True).finished() == frozenset()


def test_work_that_fails_releases_the_checkpoint(tmp_path):
    checkpoint = open_checkpoint(tmp_path, INPUTS, [])
    with pytest.raises(KeyboardInterrupt), released_on_error(checkpoint):
        raise KeyboardInterrupt
    again = open_checkpoint(tmp_path, INPUTS, [], resume=True)
    again.remove()
    assert not (tmp_path / FOLDER).exists()
    open_checkpoint(tmp_path, INPUTS, [])


def test_a_run_whose_checkpoint_is_gone_does_not_promise_to_resume_it(tmp_path):
    pieces = pieces_in(tmp_path / "marks", 3)
    pieces[1] = replace(pieces[1], fault="data")
    checkpoint = open_checkpoint(tmp_path, INPUTS, pieces)
    with pytest.raises(DataError, match="row 7") as kept:
        reduce_all(pieces, checkpoint=checkpoint)
    promise = f"finished pieces are stored in {checkpoint.folder}. Continue with --resume"
    assert promise in kept.value.__notes__
    checkpoint.release()
    checkpoint = open_checkpoint(tmp_path, INPUTS, pieces)
    with pytest.raises(DataError, match="does not exist; create it") as gone:
        reduce_all(
            pieces, checkpoint=checkpoint, progress=lambda *_: shutil.rmtree(checkpoint.folder)
        )
    assert promise not in getattr(gone.value, "__notes__", [])
