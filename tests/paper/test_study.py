"""The parts of the paper's simulation: its models, errata, energy and random motions."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from robotid.base.exceptions import SettingsError
from robotid.dynamics.simulation.motions import ProgramMotion
from robotid.paper import study
from robotid.paper.planar_2r import PAPER_PARAMETERS
from robotid.paper.procedure import LoopSettings, run_procedure
from robotid.paper.study import PaperSettings, energy_drift, paper_arm, random_runs, study_model


def test_the_physical_arm_has_four_parameters_and_the_others_the_papers_five():
    for name in ("printed", "corrected"):
        np.testing.assert_array_equal(paper_arm(name)[1], PAPER_PARAMETERS)
    np.testing.assert_allclose(paper_arm("physical")[1], [22, 5, 3, 0.1], rtol=1e-14)
    with pytest.raises(SettingsError, match=r"^model is 'other', wanted one of printed, corrected"):
        paper_arm("other")


def test_one_shot_needs_one_run_and_disturbance_shows():
    study = study_model("physical", PaperSettings(iterations=2, longest=1))
    assert study.one_shot_error < 1e-12
    assert study.errors("disturbed")[1] != study.errors()[1]
    assert study.errors("noisy")[1] != study.errors()[1]
    assert study.errors("on_program")[1] > study.errors()[1]


def test_only_the_physical_arm_keeps_its_energy():
    t, gained = energy_drift(duration=4.0, dt=4e-3)
    np.testing.assert_allclose(t, np.linspace(0.0, 4.0, 1001), atol=1e-12)
    assert {len(share) for share in gained.values()} == {1001}
    assert np.abs(gained["physical"]).max() < 1e-9  # error of the integration
    assert np.abs(gained["printed"]).max() > 0.2
    assert np.abs(gained["corrected"]).max() > 0.1  # p3 != p4


def test_random_runs_tell_every_failure(rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 8, 12, rng)
    content = runs.to_dict()
    assert 0 < content["converged"] < 8
    assert (content["runs"], content["most_iterations"], content["tolerance"]) == (8, 12, 1e-3)
    for failure in content["failures"]:
        assert runs.errors[:, failure["run"]].min() >= 1e-3
        assert re.match(r"slow: the error is .* after 12 iterations", failure["reason"])
    converged = np.setdiff1d(np.arange(8), [failure["run"] for failure in content["failures"]])
    for number, r in zip(content["iterations"], converged, strict=True):
        assert runs.errors[number, r] < 1e-3 <= runs.errors[number - 1, r]


def test_a_random_run_is_critically_damped_at_its_bandwidth(rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 2, 1, rng)
    drawn = runs.drawn
    for r, w in enumerate(drawn["gain"]):
        history = run_procedure(
            dynamics,
            partial(dynamics.acceleration, P=P),
            ProgramMotion(drawn["amplitude"][r], drawn["duration"][r]),
            drawn["guess"][[r]],
            settings=LoopSettings(alpha=2 * w, beta=w**2, iterations=1),
            offset=drawn["offset"][r],
        )
        np.testing.assert_allclose(history.relative_error(P)[:, 0], runs.errors[:, r], rtol=1e-9)
        np.testing.assert_allclose(history.tracking[:, 0], runs.history.tracking[:, r], rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"diverged": 3}, "the robot diverged from its program in iteration 3"),
        (
            {"skipped": 7},
            "slow: the error is 0.4 after 1 iterations, with a decrease of 20 % in the last 1; 7 "
            "updates were omitted, since D(q, P^) was not positive definite",
        ),
        ({"errors": [0.5, 0.6]}, "the error increased: from 0.5 to 0.6"),
        ({"errors": [0.5, 0.5]}, "stalled: the motion excites too little; the error is 0.5"),
        (
            {"errors": [0.9, 0.8, 0.5, *[0.48] * 9, 0.45]},
            "slow: the error is 0.45 after 12 iterations, with a decrease of 10 % in the last 10",
        ),
        (
            {"errors": [0.8, *[0.7] * 8, 0.6]},
            "slow: the error is 0.6 after 9 iterations, with a decrease of 25 % in the last 9",
        ),
        (
            {"errors": [0.9, *[0.4] * 11]},
            "stalled: the motion excites too little; the error is 0.4",
        ),
    ],
)
def test_each_kind_of_failure_has_its_reason(change, reason, rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 1, 1, rng)
    errors = np.array(change.pop("errors", [0.5, 0.4]))[:, None]
    history = replace(runs.history, **{key: np.array([x]) for key, x in change.items()})
    found = replace(runs, errors=errors, history=history).to_dict()["failures"]
    assert [failure["reason"] for failure in found] == [reason]


def test_each_case_has_its_own_disturbance_and_noise(rng):
    cases = list(study.CASES.values())
    found = study._influences(cases, np.random.default_rng(4))
    is_noisy = np.array([[0.0], [0.0], [0.0], [1.0], [1.0]])
    for level, size in ((found.q, 1e-5), (found.v, 1e-4), (found.a, 1e-2)):
        np.testing.assert_array_equal(level, size * is_noisy)
    u = rng.standard_normal((5, 2))
    wanted = np.array([[0.0], [0.0], [0.1], [0.0], [0.0]]) * u
    wanted *= np.random.default_rng(4).uniform(-1.0, 1.0, (5, 2))
    np.testing.assert_allclose(found.torque(np.zeros(5), u), wanted)
