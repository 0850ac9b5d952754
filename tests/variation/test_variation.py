"""What runs tell about drives, gains and a payload: from logs of a robot that differs in one."""

import numpy as np
import pytest
from helpers.driven import EXACT, FIT, arm, driven_log
from helpers.synthetic import truth

from robotid.fitting.fit import solve_recordings
from robotid.fitting.recordings import Recordings
from robotid.fitting.survey import hold_log
from robotid.judgement.unlike_runs import unlike_findings
from robotid.regressor.base_parameters import structural_mapping
from robotid.variation.groups import _inflation, runs_of
from robotid.variation.variation import UnlikeRun, Variation, vary

NAMES = [f"run_{k}.csv" for k in range(6)]
LIFT, ELBOW = "shoulder_lift_joint", "elbow_joint"
SPREAD = 0.03  # of friction between runs


def at(model, name):
    return model.layout.names.index(name)


def segments_of(model, changes=None, *, noise=0.01, seed=0, spread=SPREAD):
    """Return the segments of six logs, whose friction varies, with changes of parameters by run."""
    rng, base, logs = np.random.default_rng(seed), truth(model), []
    friction = [
        k for k, name in enumerate(model.layout.names) if name.endswith(("coulomb", "viscous"))
    ]
    for run in range(len(NAMES)):
        pi = base.copy()
        pi[friction] *= 1 + spread * rng.normal(size=len(friction))
        for name, change in (changes or {}).get(run, {}).items():
            pi[at(model, name)] += change
        logs.append(driven_log(model, pi, 10 * seed + run, duration=12.0, noise=noise))
    return logs, base


def recordings(model, logs):
    return Recordings(
        model, structural_mapping(model), [hold_log(model, log, EXACT) for log in logs]
    )


def groups_of(model, logs, standard, sigma=1.0, unit=None):
    """Return what logs tell about groups of parameters at some parameters."""
    own = recordings(model, logs)
    segments = [own.segments(k, log.whole.trajectory) for k, log in enumerate(own.fitted)]
    units = np.zeros(len(logs), int) if unit is None else np.asarray(unit)
    return runs_of(model, own.mapping, segments, standard, np.full(3, sigma), units)


@pytest.fixture(scope="module")
def model():
    return arm()


def scaled(log, joint, factor):
    tau = log.tau.copy()
    tau[:, joint] *= factor
    return type(log)(**{**vars(log), "tau": tau})


def test_each_run_tells_its_own_drives_gain_and_payload(model):
    changes = {1: {f"{LIFT}.coulomb": 0.7, f"{ELBOW}.offset": -0.4}, 4: {"wrist_1_link.m": 0.6}}
    logs, base = segments_of(model, changes, noise=0.0, spread=0.0)
    logs[2] = scaled(logs[2], 1, 1.05)
    found = {(g.group.kind, g.group.name): g for g in groups_of(model, logs, base)}
    assert [key for key in found if key[0] == "gain"] == [("gain", joint) for joint in model.joints]

    def values(group):
        runs = group.runs
        return np.array([np.linalg.solve(H, h) for H, h in zip(runs.H, runs.h, strict=True)])

    lift = found["drive", LIFT]
    wanted = np.zeros((6, len(lift.group.parameters)))
    wanted[1, lift.group.parameters.index(f"{LIFT}.coulomb")] = 0.7
    others = [0, 1, 3, 5]  # without the payload and the gain, which the drive cannot explain
    assert values(lift)[others] == pytest.approx(wanted[others], abs=1e-6)
    assert lift.centre == pytest.approx([base[at(model, n)] for n in lift.group.parameters])
    gain = values(found["gain", ELBOW])[:, 0]
    assert gain[[0, 2, 3, 5]] == pytest.approx([0.0, 0.05, 0.0, 0.0], abs=1e-6)
    assert found["gain", ELBOW].centre.tolist() == [1.0]
    payload = found["payload", "wrist_1_link"]
    assert payload.group.parameters[0] == "wrist_1_link.m"
    assert payload.group.units == ("kg", "kg m", "kg m", "kg m")
    # the plane of the arm hides the first moment along the axes
    assert np.linalg.matrix_rank(payload.runs.H[4], rtol=1e-6) == 3
    x = np.linalg.lstsq(payload.runs.H[4], payload.runs.h[4], rcond=1e-9)[0]
    assert x[0] == pytest.approx(0.6, abs=1e-6)


def test_scales_are_a_tenth_of_the_drive_and_a_hundredth_of_the_robot(model):
    logs, base = segments_of(model, noise=0.0, spread=0.0)
    found = {(g.group.kind, g.group.name): g for g in groups_of(model, logs, base, sigma=2.0)}
    drive = found["drive", ELBOW]
    H = drive.runs.H.sum(axis=0) * drive.inflation
    torque = np.sqrt(drive.centre @ H @ drive.centre)
    assert drive.runs.scale == pytest.approx(0.1 * torque / np.sqrt(np.diag(H)))
    assert found["gain", ELBOW].runs.scale == pytest.approx([0.02])
    mass = 0.01 * sum(base[at(model, f"{body}.m")] for body in model.layout.bodies)
    payload = found["payload", "wrist_1_link"].runs.scale
    assert payload == pytest.approx([mass, 0.1 * mass, 0.1 * mass, 0.1 * mass])


def test_information_counts_the_noise_of_the_segments(model):
    logs, base = segments_of(model, noise=0.02, spread=0.0, seed=3)
    level = float(np.std(logs[0].tau[:, 0])) * 0.02
    z = []
    for group in groups_of(model, logs, base, sigma=level):
        if group.group.kind == "drive":
            assert 0.02 < group.inflation < 20
            for H, h in zip(group.runs.H, group.runs.h, strict=True):
                z += (np.linalg.solve(H, h) / np.sqrt(np.diag(np.linalg.inv(H)))).tolist()
    assert 0.6 < np.std(z) < 1.6  # errors as large as stated


def test_inflation_is_1_for_independent_rows():
    rng, found = np.random.default_rng(0), []
    for _ in range(150):
        runs = []
        for rows in (6, 9, 20):
            A = rng.normal(size=(4, rows, 3))
            e = 1.5 * rng.normal(size=(4, rows))
            runs.append((np.einsum("sri,srj->sij", A, A), np.einsum("sri,sr->si", A, e)))
        found.append(_inflation(runs))
    assert np.mean(found) == pytest.approx(1.5**2, rel=0.06)


def test_rows_are_divided_by_the_noise_of_their_joint(model):
    logs, base = segments_of(model, noise=0.02, spread=0.0, seed=3)
    own = recordings(model, logs)
    segments = [own.segments(k, log.whole.trajectory) for k, log in enumerate(own.fitted)]
    found = [
        runs_of(model, own.mapping, segments, base, np.array(sigma), np.zeros(6, int))
        for sigma in ([1.0, 1.0, 1.0], [1.0, 2.0, 5.0])
    ]
    for one, other in zip(*found, strict=True):
        if one.group.kind == "gain":
            factor = {"shoulder_lift_joint": 1.0, "elbow_joint": 4.0, "wrist_1_joint": 25.0}
            H, less = (x.runs.H * x.inflation for x in (one, other))
            assert less * factor[one.group.name] == pytest.approx(H)


@pytest.mark.parametrize(("kind", "where", "name", "value"), [
    ("drive", LIFT, f"{LIFT}.coulomb", 7.0),
    ("gain", ELBOW, f"{ELBOW}.gain", 1.12),
    ("payload", "wrist_1_link", "wrist_1_link.m", 0.8),
    ("none", "", "", 0.0),
])  # fmt: skip
def test_the_run_that_differs_is_named_with_its_cause(model, kind, where, name, value):
    before = truth(model)
    change = {"drive": {f"{LIFT}.coulomb": value - before[at(model, f"{LIFT}.coulomb")]},
              "payload": {"wrist_1_link.m": value}}.get(kind, {})  # fmt: skip
    logs, _ = segments_of(model, {3: change}, seed=1)
    if kind == "gain":
        logs[3] = scaled(logs[3], 1, value)
    fit = solve_recordings(recordings(model, logs), FIT).with_errors()
    variation = vary(NAMES, fit.runs)
    assert variation.runs == tuple(NAMES)
    assert variation.units == 1
    if kind == "none":
        assert variation.unlike == ()
        return
    (found,) = variation.unlike
    assert (found.run, found.kind, found.where) == (3, kind, where)
    if kind == "gain":
        assert found.value == pytest.approx(value, abs=0.03)
    if kind == "payload":
        assert found.name == name
        assert found.value == pytest.approx(value, abs=0.1)
    assert not found.ends[0] < found.value < found.ends[1]
    assert found.probability < 0.02 / 100


def test_parameters_have_their_mean_spread_and_next_interval(model):
    logs, base = segments_of(model, spread=0.1, seed=2)
    fit = solve_recordings(recordings(model, logs), FIT).with_errors()
    found = {each.name: each for each in vary(NAMES, fit.runs).parameters}
    name = f"{LIFT}.coulomb"
    true = base[at(model, name)]
    coulomb = found[name]
    assert coulomb.unit == "N m"
    assert coulomb.prediction.mean == pytest.approx(true, rel=0.15)
    assert coulomb.prediction.spread == pytest.approx(0.1 * true, rel=0.7)
    assert coulomb.prediction.ends[0] < true < coulomb.prediction.ends[1]
    assert coulomb.values.std() == pytest.approx(0.1 * true, rel=0.7)
    assert coulomb.within is None
    rng, own = np.random.default_rng(2), []
    names = [n for n in model.layout.names if n.endswith(("coulomb", "viscous"))]
    for _ in NAMES:
        own.append(true * (1 + 0.1 * rng.normal(size=len(names))[names.index(name)]))
    assert (np.abs(coulomb.values - own) < 5 * coulomb.std_errors).all()
    assert coulomb.to_dict()["by_log"] == coulomb.values.tolist()


def test_two_logs_have_no_variation_and_three_are_not_compared(model):
    logs, _ = segments_of(model, seed=2)
    assert (
        vary(NAMES[:2], solve_recordings(recordings(model, logs[:2]), FIT).with_errors().runs)
        is None
    )
    logs[2] = scaled(logs[2], 1, 1.3)
    three = vary(NAMES[:3], solve_recordings(recordings(model, logs[:3]), FIT).with_errors().runs)
    assert three.unlike == ()
    assert len(three.parameters) > 5


def test_findings_name_log_value_and_prediction():
    ends = np.array([0.98, 1.03])
    gain = UnlikeRun(1, "gain", "elbow", "elbow.gain", "-", 1.2, 0.011, ends, 1e-7)
    drive = UnlikeRun(
        0, "drive", "elbow", "elbow.coulomb", "N m", 8.21, 0.12, np.array([5.0, 6.0]), 1e-6
    )
    load = UnlikeRun(2, "payload", "tool", "tool.m", "kg", 2.81, 0.02, np.array([-0.1, 0.1]), 1e-9)
    found = [
        *unlike_findings(
            Variation(("a.csv", "b.csv", "c.csv", "d.csv"), 1, (), (gain, drive, load))
        )
    ]
    assert [each.where for each in found] == ["b.csv", "a.csv", "c.csv"]
    assert {each.code for each in found} == {"unlike_run"}
    assert found[0].message.startswith(
        "b.csv: the torque of elbow differs from that of the fit by +20 +- 1.1 %; 3 other logs "
        "predict -2 to +3 %. The torque constant"
    )
    assert found[1].message.startswith(
        "a.csv: elbow.coulomb is 8.21 +- 0.12 N m; 3 other logs predict 5 to 6 N m. Temperature"
    )
    assert found[2].message.startswith(
        "c.csv: tool.m is 2.81 +- 0.02 kg more than in the other logs; 3 other logs predict "
        "-0.1 to 0.1 kg. A load"
    )
    assert found[0].evidence == {
        "value": 1.2, "std_error": 0.011, "low": 0.98, "high": 1.03, "probability": 1e-7,
    }  # fmt: skip
    assert [*unlike_findings(None)] == []
