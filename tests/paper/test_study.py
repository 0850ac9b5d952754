"""The parts of the paper's simulation: its models, errata, energy and random motions."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.base.exceptions import SettingsError
from robotid.dynamics.simulation.motions import ProgramMotion
from robotid.paper import errata as errata_module
from robotid.paper import study
from robotid.paper.equations import LinearPlant, torque
from robotid.paper.errata import energy_drift, errata
from robotid.paper.planar_2r import PAPER_PARAMETERS
from robotid.paper.procedure import LoopSettings, run_procedure
from robotid.paper.study import (
    DURATION,
    PROGRAM,
    PaperSettings,
    paper_arm,
    random_runs,
    study_model,
)


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


def test_the_errata_make_the_torques_differ_as_worked_out_by_hand():
    found = {e.where: e for e in errata(np.random.default_rng(0))}
    assert len(found) == 5
    # h = 3 s2 + 0.1 c2 <= 3.002: C122 and C112 together miss 2 h v2 (v1 + v2) <= 3.002 * 400
    assert 1000 < found["(26)"].max_torque_difference < 3.002 * 400
    # column 4 is off by s2 (v1^2 + v2^2) <= 200, times p3 = 3
    assert 500 < found["G, column 4"].max_torque_difference < 600
    # p4 of (27) is 2 instead of 3, times s2 v^2 <= 100
    assert 95 < found["(27), p4"].max_torque_difference < 100
    # D a = u - C with u = (D q_* + C) / 2: G P^ - u = D (a - q_*) / 2 = -(D q_* + C) / 4
    t = np.linspace(0, DURATION, 401)
    program = torque(*paper_arm("physical")[:1], *PROGRAM.evaluate(t), paper_arm("physical")[1])
    unseen = found["(23) with Ψ of (22), residual at P̂ = P / 2"]
    wanted = np.abs(program).max() / 4
    np.testing.assert_allclose(unseen.max_torque_difference_on_program, wanted, rtol=1e-12)
    for erratum in found.values():
        assert 1.0 < erratum.max_torque_difference_on_program < erratum.max_torque_difference


def test_only_the_physical_arm_keeps_its_energy():
    drift = energy_drift(duration=4.0, dt=4e-3)
    np.testing.assert_allclose(drift.t, np.linspace(0.0, 4.0, 1001), atol=1e-12)
    assert {len(gained) for gained in drift.gained.values()} == {1001}
    assert np.abs(drift.gained["physical"]).max() < 1e-9  # error of the integration
    assert np.abs(drift.gained["printed"]).max() > 0.2
    assert np.abs(drift.gained["corrected"]).max() > 0.1  # p3 != p4


def test_random_runs_tell_every_failure(rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 8, 12, rng)
    content = runs.to_dict()
    assert 0 < content["converged"] < 8
    assert (content["runs"], content["most_iterations"], content["tolerance"]) == (8, 12, 1e-3)
    for failure in content["failures"]:
        assert runs.errors[:, failure["run"]].min() >= 1e-3
        assert re.match(r"slow: the error is .* after 12 iterations", failure["reason"])
    for number, r in zip(runs.iterations, np.flatnonzero(runs.has_converged), strict=True):
        assert runs.errors[number, r] < 1e-3 <= runs.errors[number - 1, r]


def test_a_random_run_is_critically_damped_at_its_bandwidth(rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 2, 1, rng)
    for r, w in enumerate(runs.gain):
        history = run_procedure(
            dynamics,
            LinearPlant(dynamics, P),
            ProgramMotion(runs.amplitude[r], runs.duration[r]),
            runs.guess[[r]],
            settings=LoopSettings(alpha=2 * w, beta=w**2, iterations=1),
            offset=runs.offset[r],
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
    found = replace(runs, errors=errors, history=history).failures
    assert [failure["reason"] for failure in found] == [reason]


def test_each_failure_has_the_end_and_the_omitted_updates_of_its_run(rng):
    history = SimpleNamespace(diverged=[0, 0, 0, 0], skipped=[0, 5, 9, 0])
    errors = np.array([[0.9, 0.8, 0.7, 0.6], [0.2, 0.1, 1e-4, 0.3], [0.4, 0.3, 0.5, 0.2]])
    drawn = {name: rng.uniform(0.5, 2.0, (4, 2)) for name in ("amplitude", "guess", "offset")}
    drawn |= {name: rng.uniform(0.5, 2.0, 4) for name in ("duration", "gain")}
    found = study.RandomRuns(errors=errors, history=history, **drawn).failures
    assert [(f["run"], f["relative_error"]) for f in found] == [(0, 0.4), (1, 0.3), (3, 0.2)]
    assert ["5 updates were omitted" in f["reason"] for f in found] == [False, True, False]
    for failure in found:
        for name, values in drawn.items():
            assert failure[name] == values[failure["run"]].tolist()


@pytest.mark.parametrize("name", ["iterations", "longest", "runs", "patience"])
def test_settings_below_one_are_named(name):
    with pytest.raises(SettingsError, match=f"^{name} is 0, wanted 1 or more$"):
        PaperSettings(**{name: 0})


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


def test_a_study_is_its_cases_an_endless_run_and_a_single_one(monkeypatch):
    given, P = [], PAPER_PARAMETERS

    def run(dynamics, plant, motion, P0, **options):
        given.append((P0, options))
        NA = np.array([[7, 8, 9, 10, 11], [31], [5]][len(given) - 1])
        error = np.array([[0.5], [0.25 * len(given)]])
        return SimpleNamespace(NA=NA, relative_error=lambda P: error)

    monkeypatch.setattr(study, "run_procedure", run)
    found = study.study_model("printed", PaperSettings(iterations=13, longest=44))
    (P0, cases), (one, endless), (other, once) = given
    np.testing.assert_array_equal(P0, np.tile(P / 2, (5, 1)))
    np.testing.assert_array_equal([one, other], [P[None] / 2] * 2)
    assert (cases["settings"].iterations, cases["settings"].eps1) == (13, 1e-9)
    assert cases["settings"].eps2.tolist() == [1e-12] * 4 + [1.0]
    degree = [np.pi / 180, 0.0]
    np.testing.assert_array_equal(cases["offset"], [degree, [0.0, 0.0], *[degree] * 3])
    assert cases["keep_torques"]
    assert (endless["settings"].iterations, endless["settings"].method) == (44, "recursive")
    assert (once["settings"].iterations, once["settings"].method) == (1, "one_shot")
    for options in (endless, once):
        np.testing.assert_array_equal(options["offset"], degree)
    assert (found.NA, found.one_shot_error, found.name) == (31, 0.75, "printed")


def test_the_program_control_has_the_true_parameters():
    dynamics, P = paper_arm("physical")
    history = SimpleNamespace(estimates=np.zeros((3, 5, len(P))))
    t, control = study.ModelStudy("physical", dynamics, P, history, None, 0.0).program_control(5)
    np.testing.assert_allclose(t, [0.0, 0.5, 1.0, 1.5, 2.0])
    for k, parts in enumerate(zip(*PROGRAM.evaluate(t), strict=True)):
        wanted = dynamics.regressor(*parts) @ P
        np.testing.assert_allclose(control[k], wanted, rtol=1e-12)
    assert np.abs(control).max() > 0.1


def test_random_properties_are_each_run_s_and_each_joint_s_own(monkeypatch):
    monkeypatch.setattr(
        study, "run_procedure", lambda *_, **__: SimpleNamespace(relative_error=lambda P: P)
    )
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 4000, 1, np.random.default_rng(0), largest_offset=0.07)
    drawn = {
        "size": (np.abs(runs.amplitude), 0.5, 2.0), "duration": (runs.duration[:, None], 1.0, 3.0),
        "gain": (runs.gain[:, None], 5.0, 20.0), "guess": (runs.guess / P, 0.3, 1.7),
        "offset": (runs.offset, -0.07, 0.07), "sign": (np.sign(runs.amplitude), -1.0, 1.0),
    }  # fmt: skip
    for x, low, high in drawn.values():
        assert x.min() >= low
        assert x.max() <= high
        np.testing.assert_allclose(x.mean(axis=0), (low + high) / 2, atol=0.03 * (high - low))
        ends = np.array([low, high])
        np.testing.assert_allclose([x.min(), x.max()], ends, atol=0.01 * (high - low))
    every = np.hstack([x for x, *_ in drawn.values()])
    assert np.abs(np.corrcoef(every.T) - np.eye(every.shape[1])).max() < 0.06


def test_a_slow_course_is_reported_by_its_last_ten_iterations():
    error = 0.8 * 0.97 ** np.arange(26)
    assert study._course(error) == (
        f"slow: the error is {error[-1]:.2g} after 25 iterations, with a decrease of "
        f"{100 * (1 - 0.97**10):.2g} % in the last 10"
    )
    assert "a decrease of 8.7 % in the last 3" in study._course(error[:4])
    still = np.append(error, np.full(11, 0.37))
    assert study._course(still).startswith("stalled: ")
    assert study._course(still).endswith("the error is 0.37")
    assert study._course(np.array([0.5, 0.1, 0.61])) == "the error increased: from 0.5 to 0.61"


def test_differences_of_the_errata_are_their_terms_at_every_state(rng):
    q, v, a = 3.0 * rng.standard_normal((3, 40, 2))
    s, c, (v1, v2) = np.sin(q[:, 1]), np.cos(q[:, 1]), v.T
    missing, swapped, p4, residual, _ = errata_module._differences(q, v, a)
    h = 3.0 * s + 0.1 * c
    np.testing.assert_allclose(missing[:, 0], 2 * h * v2**2 + 2 * h * v1 * v2, atol=1e-9)
    assert not missing[:, 1].any()
    both = 3.0 * s * (v1**2 + v2**2)
    np.testing.assert_allclose(swapped, np.column_stack([both, -both]), atol=1e-9)
    printed = -1.0 * np.column_stack([s * v1**2, -s * v2**2])
    np.testing.assert_allclose(p4, printed, atol=1e-9)
    dynamics, P = paper_arm("physical")
    np.testing.assert_allclose(residual, 2 * torque(dynamics, q, v, a, P), atol=1e-9)


def test_an_erratum_has_its_largest_difference_of_either_joint_and_sign(monkeypatch, rng):
    sizes = iter(np.arange(1.0, 11.0))

    def differences(q, v, a):
        assert len(q) in (2000, 401)
        found = 0.5 * np.ones((5, 7, 2))
        for k in range(5):
            found[k, k, k % 2] = (-1) ** k * next(sizes)
        return found

    monkeypatch.setattr(errata_module, "_differences", differences)
    found = errata(rng)
    assert [e.max_torque_difference for e in found] == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert [e.max_torque_difference_on_program for e in found] == [6.0, 7.0, 8.0, 9.0, 10.0]
