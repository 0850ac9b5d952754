"""Motions designed, foreseen, simulated and tracked: figures as stored, and from the files."""

import csv

import numpy as np
import pytest
from helpers.figure_runs import LOAD


@pytest.mark.parametrize("name", ["design", "tracked"])
def test_all_figures_are_those_that_are_stored(same, name):
    same(name)


RANGES = (("lift", -0.1, 1.3), ("reach", 0.05, 0.25), ("roll", 0.0, np.pi))  # middle, half


def table(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def test_a_design_uses_of_each_limit_what_its_file_shows(ran):
    runs, found = ran("design")
    margins = found["searched"]["limits"]
    motion = table(runs.folder / "searched.csv")
    np.testing.assert_allclose(motion["time"], np.arange(201) / 50, atol=1e-12)
    speed = {j: np.abs(motion[f"dq_{j}"]).max() / (0.7 * most)
             for j, most in (("lift", 2.5), ("reach", 0.8), ("roll", 4.0))}  # fmt: skip
    worst = max(speed, key=speed.get)
    assert margins["velocity"]["where"] == worst
    assert 1 - margins["velocity"]["margin"] == pytest.approx(speed[worst], abs=0.02)
    used = {j: np.abs(motion[f"q_{j}"] - middle).max() / (0.7 * half)
            for j, middle, half in (RANGES)}  # fmt: skip
    assert 1 - margins["position"]["margin"] == pytest.approx(max(used.values()), abs=0.02)
    wanted = np.abs(motion["ddq_lift"]).max() / 3
    assert 1 - margins["acceleration"]["margin"] == pytest.approx(wanted, abs=0.02)


def test_a_preview_rests_on_the_noise_that_is_stated(ran):
    noise = ran("design")[1]["preview"]["noise"]
    assert {j: (n["std"], n["correlation"]) for j, n in noise.items()} == {
        "lift": (0.8, 0.07), "reach": (1.1, 0.07), "roll": (0.07, 0.07)
    }  # fmt: skip


def test_a_simulated_log_has_the_torques_of_its_truth(ran):
    runs, found = ran("design")
    truth, log = found["truth"], table(runs.folder / "log.csv")
    values = {e["name"]: e["value"] for e in truth["standard_parameters"]}
    values |= {e["name"]: e["value"] for e in truth["drive_parameters"]}
    assert values["lift.stribeck"] == 1.5
    assert truth["samples"] == len(log["time"])
    assert len(log["time"]) == pytest.approx(0.95 * (3 * 125 + 1), rel=0.03)
    steps = log["q_lift"] / 2e-5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)


def test_a_load_is_named_when_it_was_picked_up(ran):
    track = ran("tracked")[1]["track"]
    changes = track["changes"]
    assert len(changes) >= 1
    assert abs(changes[0]["onset"] - 42.0) < 0.6
    assert 42.0 <= changes[0]["flagged"] < 44.0
    assert LOAD[0] == 1.7
