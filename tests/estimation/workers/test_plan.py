"""Who works, what is shown of it and what is kept, figure by figure."""

import json
from types import SimpleNamespace

import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.estimation.workers import plan as module
from robotid.estimation.workers.checkpoint import Checkpoint
from robotid.estimation.workers.cluster import ClusterBackend
from robotid.estimation.workers.plan import WorkPlan, choose_workers, map_pieces
from robotid.estimation.workers.processes import ProcessBackend, SerialBackend


def pieces_of(*samples):
    return [SimpleNamespace(name=f"piece {k}", samples=n) for k, n in enumerate(samples)]


def test_workers_are_as_many_as_are_asked_for_or_pay_their_start(monkeypatch):
    monkeypatch.setattr(module, "available_cores", lambda: 4)
    half, small = 250_000, 249_999
    assert choose_workers(pieces_of(half, half)) == 2  # not more than pieces
    assert choose_workers(pieces_of(*[half] * 9)) == 4
    assert choose_workers(pieces_of(half, small)) == 1  # too little in all
    assert choose_workers(pieces_of(2 * half)) == 1
    assert choose_workers(pieces_of(1, 1, 1), 2) == 2
    assert choose_workers(pieces_of(1, 1, 1), 8) == 3
    assert choose_workers([], 8) == 1
    with pytest.raises(SettingsError, match="workers is 0"):
        choose_workers([], 0)


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({}, False), ({"workers": None}, False), ({"workers": 2}, True), ({"workers": 3}, True),
        ({"scheduler": "tcp://a:1"}, True),
    ],
)  # fmt: skip
def test_what_short_logs_have_no_use_of_is_known(options, wanted):
    assert WorkPlan(**options).is_asked_for is wanted


def test_a_plan_chooses_who_works():
    pieces = pieces_of(1, 1, 1)
    assert isinstance(WorkPlan(1)._choose(pieces), SerialBackend)
    found = WorkPlan(2)._choose(pieces)
    assert isinstance(found, ProcessBackend)
    assert found.workers == 2
    found = WorkPlan(2, "tcp://here:8786")._choose(pieces)
    assert isinstance(found, ClusterBackend)
    assert found.address == "tcp://here:8786"


def test_worker_processes_are_kept_from_one_work_of_an_open_plan_to_the_next():
    plan, used = WorkPlan(2), []
    with plan:
        for _ in range(2):
            with plan._backend(pieces_of(1, 1)) as backend:
                used.append(backend)
    with plan._backend(pieces_of(1, 1)) as backend:
        used.append(backend)
    assert used[0] is used[1]
    assert used[2] is not used[0]


class Backwards(SerialBackend):
    """Finishes the last piece first."""

    def run(self, work, pieces, lost=None):
        yield from super().run(work, list(pieces)[::-1], lost)


def test_results_come_in_order_and_progress_counts_what_is_done_however_it_ends():
    saved, shown = [], []
    checkpoint = SimpleNamespace(
        folder=None,
        finished=lambda: frozenset({1, 4}),
        load=lambda k: f"kept {k}",
        save=lambda *given: saved.append(given),
    )
    pieces = pieces_of(10, 200, 3000, 40_000, 500_000)
    found = map_pieces(
        lambda piece, threads: f"{piece.samples} by {threads}",
        pieces,
        "counting",
        backend=Backwards(),
        progress=lambda *told: shown.append(told),
        checkpoint=checkpoint,
    )
    assert list(found) == ["10 by None", "kept 1", "3000 by None", "40000 by None", "kept 4"]
    assert saved == [
        (3, "piece 3", "40000 by None"),
        (2, "piece 2", "3000 by None"),
        (0, "piece 0", "10 by None"),
    ]
    done = [500_200, 540_200, 543_200, 543_210]
    assert shown == [("counting", n, 543_210, "samples") for n in done]


def test_a_plan_hands_on_work_name_progress_and_backend():
    shown = []
    with WorkPlan(1, progress=lambda *told: shown.append(told)) as plan:
        found = plan.map(lambda piece, _: piece.samples, pieces_of(3, 4), "counting")
        assert list(found) == [3, 4]
    assert shown == [("counting", n, 7, "samples") for n in (0, 3, 7)]


def test_other_inputs_are_named_up_to_five_and_the_rest_is_counted(tmp_path):
    inputs = {f"key{k}": k for k in range(7)} | {"long": "x" * 90}
    pieces = pieces_of(1, 2, 3)
    Checkpoint.open(tmp_path, inputs, pieces, dict).release()
    other = {key: -1 for key in inputs}
    pieces[2].name = "another"
    with pytest.raises(DataError) as caught:
        Checkpoint.open(tmp_path, other, pieces, dict, resume=True)
    said = str(caught.value)
    assert "key0 was 0, is -1; key1 was 1, is -1; " in said
    assert "key4 was 4, is -1, and 4 more. Restore the inputs" in said
    with pytest.raises(DataError) as caught:
        Checkpoint.open(tmp_path, inputs | {"long": "y"}, pieces, dict, resume=True)
    said = str(caught.value)
    assert f"long was '{'x' * 56}..., is 'y'; pieces[2] was 'piece 2', is 'another'. " in said
    # what was kept is as it was
    stated = json.loads((tmp_path / ".robotid-checkpoint" / "inputs.json").read_text())
    assert stated == {**inputs, "pieces": [f"piece {k}" for k in range(3)]}


def test_a_plan_hands_on_all_that_is_stated(monkeypatch):
    given = []
    monkeypatch.setattr(module, "map_pieces", lambda *args, **how: given.append((args, how)) or [7])
    stated = {"checkpoint": object(), "counted": "draws", "lost": object()}
    progress, pieces = object(), [SimpleNamespace(samples=1)]
    assert list(WorkPlan(progress=progress).map("work", pieces, "doing", **stated)) == [7]
    ((args, how),) = given
    assert args == ("work", pieces, "doing")
    assert isinstance(how.pop("backend"), SerialBackend)
    assert how == {"progress": progress, **stated}
