"""What runs tell about drives, gains and a payload: from logs of a robot that differs in one."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.driven import EXACT, FIT, arm, driven_log
from helpers.synthetic import truth

from robotid.diagnosis.verdict.fit_findings import unlike_findings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.fit import run_sums, solve_recordings
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.estimation.variation.groups import (
    Group,
    RunsOf,
    groups_at,
    inflation_of,
    runs_of,
    sums_of,
)
from robotid.estimation.variation.spread import Runs, SpreadModel
from robotid.estimation.variation.variation import between_covariance, shrunk_correlation, vary
from robotid.robot.model import RobotModel

NAMES = [f"run_{k}.csv" for k in range(6)]
LIFT, ELBOW = "shoulder_lift_joint", "elbow_joint"
SPREAD = 0.03  # of friction between runs


def at(model, name):
    return model.layout.names.index(name)


def segments_of(model, changes=None, *, noise=0.01, seed=0, spread=SPREAD, rate=60.0):
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
        logs.append(driven_log(model, pi, 10 * seed + run, duration=12.0, rate=rate, noise=noise))
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
    sums = sums_of(model, own.mapping, segments, standard, np.full(3, sigma))
    return runs_of(model, own.mapping, standard, sums, units)


def scaled(log, joint, factor):
    tau = log.tau.copy()
    tau[:, joint] *= factor
    return type(log)(**{**vars(log), "tau": tau})


def slipped(log, joint, size):
    """Return a log whose encoder has slipped."""
    q = log.q.copy()
    q[:, joint] += size
    return type(log)(**{**vars(log), "q": q})


def test_rows_of_zeros_are_differences_of_the_torque(model):
    """Two logs with noise levels by joint, rows that are left out, weights and a shift."""
    logs, base = segments_of(model, noise=0.02, seed=4)
    own = recordings(model, [logs[0], logs[1].window(end=float(logs[1].t[-1]) - 4.0)])
    own.fitted[0].whole.mask[::3, 1] = False
    weights = [1.0 + np.arange(log.whole.mask.size).reshape(log.whole.mask.shape) % 3
               for log in own.fitted]  # fmt: skip
    own, sigma = replace(own, weights=tuple(weights)), np.array([1.0, 2.0, 5.0])
    shift = 0.01 * own.mapping.to_base(base)
    segments = [
        [part.without(shift) for part in own.segments(k, log.whole.trajectory)]
        for k, log in enumerate(own.fitted)
    ]
    plain = sums_of(model, own.mapping, segments, base, sigma)
    found = run_sums(own, segments, base, sigma, shift)
    groups = [group for group, _ in groups_at(model, own.mapping, base)]
    assert [(g.name, g.units) for g in groups[-3:]] == [(j, ("rad",)) for j in model.joints]
    h, parts = 1e-6, [[] for _ in model.joints]
    for k, log in enumerate(own.fitted):
        motion, w = log.whole.trajectory, (log.whole.mask * weights[k] / sigma**2).ravel()
        W = regressor_rows(own, k, motion)
        D = np.stack([
            (regressor_rows(own, k, replace(motion, q=motion.q - h * e))
             - regressor_rows(own, k, replace(motion, q=motion.q + h * e))) / (2 * h)
            @ own.mapping.to_base(base) for e in np.eye(3)
        ], 1)  # fmt: skip
        r = motion.tau.ravel() - W @ (own.mapping.to_base(base) + shift)
        cuts = np.arange(own.segment_length(k) * 3, len(r), own.segment_length(k) * 3)
        for j, part in enumerate(parts):
            x = [(w * D[:, j] * y) for y in (D[:, j], r)]
            H, g = ([each.sum() for each in np.split(y, cuts)] for y in x)
            part.append((np.array(H)[:, None, None], np.array(g)[:, None]))
        np.testing.assert_allclose(np.diag(found.H[k])[-3:], w @ D**2, rtol=1e-5)
        np.testing.assert_allclose(found.h[k, -3:], D.T @ (w * r), rtol=1e-4)
        np.testing.assert_allclose(found.H[k, :-3, :-3], plain.H[k, :-3, :-3], rtol=0)
        np.testing.assert_allclose(found.h[k, :-3], plain.h[k, :-3], rtol=0)
    np.testing.assert_allclose(found.scatter[:-3], plain.scatter[:-3], rtol=0)
    for j in range(3):
        wanted = inflation_of(parts[j])
        assert found.scatter[j - 3, 0] / found.scatter[j - 3, 1] == pytest.approx(wanted, rel=1e-4)


def regressor_rows(own, k, motion):
    problem = own.problem_of(k, motion)
    return np.vstack([W for W, _, _ in problem.blocks()])


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
    # zeros: none are computed here
    assert not any(kind == "zero" for kind, _ in found)
    payload = found["payload", "wrist_1_link"].runs.scale
    assert payload == pytest.approx([mass, 0.1 * mass, 0.1 * mass, 0.1 * mass])


@pytest.mark.parametrize("level", [1.5, 0.4])
def test_inflation_is_1_for_independent_rows(level):
    rng, found = np.random.default_rng(0), []
    for _ in range(600):
        runs = []
        for rows in (6, 9, 20):
            A = rng.normal(size=(4, rows, 3))
            e = level * rng.normal(size=(4, rows))
            runs.append((np.einsum("sri,srj->sij", A, A), np.einsum("sri,sr->si", A, e)))
        found.append(inflation_of(runs))
    assert np.mean(found) == pytest.approx(level**2, rel=0.035)


@pytest.mark.parametrize(("kind", "where", "name", "value"), [
    ("drive", LIFT, f"{LIFT}.coulomb", 7.0),
    ("gain", ELBOW, f"{ELBOW}.gain", 1.12),
    ("payload", "wrist_1_link", "wrist_1_link.m", 0.8),
    ("zero", ELBOW, f"{ELBOW}.zero", 0.06),
    ("none", "", "", 0.0),
])  # fmt: skip
def test_the_run_that_differs_is_named_with_its_cause(model, kind, where, name, value):
    before = truth(model)
    change = {"drive": {f"{LIFT}.coulomb": value - before[at(model, f"{LIFT}.coulomb")]},
              "payload": {"wrist_1_link.m": value}}.get(kind, {})  # fmt: skip
    logs, _ = segments_of(model, {3: change}, seed=1, rate=30.0)
    if kind == "gain":
        logs[3] = scaled(logs[3], 1, value)
    if kind == "zero":
        logs[3] = slipped(logs[3], 1, value)
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
    if kind == "zero":
        assert (found.name, found.unit) == (name, "rad")
        assert found.value == pytest.approx(value, abs=0.006)
        (finding,) = unlike_findings(variation)
        said = f"differ by {value:+.1g}"[:-1]
        assert f"run_3.csv: the positions of {ELBOW} {said}" in finding.message
        assert "rad from those in the other logs; 5 other logs predict -0.0" in finding.message
    assert not found.ends[0] < found.value < found.ends[1]
    assert found.probability < 0.02 / 100


def stated(name, x, error, *, unit=None, scale=1.0):
    """Return estimates (k, q) of the terms of a drive in k runs, each with one standard error."""
    count, size = np.shape(x)
    names = tuple(f"{name}.{k}" for k in range(size))
    group = Group("drive", name, names, ("N m",) * size, np.eye(size), (0,))
    H, units = np.tile(np.eye(size) / error**2, (count, 1, 1)), np.zeros(count, int)
    units = units if unit is None else np.asarray(unit)
    runs = Runs(H, np.asarray(x) / error**2, units, np.full(size, scale))
    return RunsOf(group, np.zeros(size), runs, 1.0)


def test_a_payload_is_compared_only_in_runs_that_determine_it():
    """Runs of 4 parameters with scale 1; run 6 differs by 40 along its determined direction.

    No run has information on parameter 2 (no motion determines it). Run 6 has sd 0.1 along
    (1, 0, 0, 1) / sqrt(2), and the information ``weak`` across it and on parameter 1.
    """
    rng, along = np.random.default_rng(5), np.array([1.0, 0.0, 0.0, 1.0]) / np.sqrt(2.0)
    known = np.diag([1.0, 1.0, 0.0, 1.0])
    x = 0.3 * rng.normal(size=(7, 4))
    x[6] += 40.0 * along

    def unlike(weak, kind="payload", of_others=known, unit=(0,) * 7, run=tuple(range(7))):
        H = np.tile(100.0 * of_others, (len(run), 1, 1))
        H[6] = (100.0 - weak) * np.outer(along, along) + weak * known
        names = ("m", "mcx", "mcy", "mcz")
        group = Group(kind, "tool", tuple(f"tool.{n}" for n in names), ("kg",) * 4, np.eye(4), (0,))
        runs = Runs(H, np.einsum("kij,kj->ki", H, x[list(run)]), np.array(unit), np.ones(4))
        own = vary(list("abcdefgh")[: len(run)], (RunsOf(group, np.zeros(4), runs, 1.0),))
        return [(each.run, each.kind) for each in own.unlike_units or own.unlike]

    # sd of m and mcz: sqrt(0.5 / 100 + 0.5 / weak); 1 at weak = 0.5025; of mcx: 1 / sqrt(weak)
    assert unlike(1.1) == [(6, "payload")]
    assert unlike(0.9) == []  # mcx: 1.05
    assert unlike(0.9, "drive") == [(6, "drive")]
    assert unlike(0.9, of_others=np.diag([1.0, 0, 0, 1])) == [(6, "payload")]  # no run has mcx
    # units of a run each, the last one with a second run that determines the payload
    every, second = tuple(range(7)), (*range(7), 6)
    assert unlike(0.9, unit=every) == []
    assert unlike(0.9, unit=second, run=second) == [(6, "payload")]


def test_gains_are_of_the_rows_of_joints_behind_those_of_a_floating_base():
    free = RobotModel.from_urdf(arm().tree.path, joints=(LIFT, ELBOW), free_flyer=True)
    groups = groups_at(free, structural_mapping(free), free.standard_parameters())
    gains = {group.name: group.rows for group, _ in groups if group.kind == "gain"}
    assert gains == {LIFT: (6,), ELBOW: (7,)}
    assert gains == {joint: (free.row_names.index(joint),) for joint in (LIFT, ELBOW)}


def test_two_logs_have_no_variation_and_three_are_not_compared():
    x = np.array([[0.0, 1.0], [0.1, 0.9], [50.0, 60.0]])
    assert vary(NAMES[:2], (stated("b", x[:2], 0.1),)) is None
    three = vary(NAMES[:3], (stated("b", x, 0.1),))
    assert (three.unlike, len(three.parameters)) == ((), 2)


def units_of(rng, shift, *, units=5, runs=2):
    """Return a group of two payload terms in runs of units; one unit is shifted."""
    unit = np.repeat(np.arange(units), runs)
    x = 0.1 * rng.normal(size=(units, 2))[unit] + 0.05 * rng.normal(size=(len(unit), 2))
    x[unit == 3] += shift
    H = np.tile(np.diag([400.0, 900.0]), (len(unit), 1, 1))
    h = np.einsum("kij,kj->ki", H, x + rng.normal(size=x.shape) / [20.0, 30.0])
    group = Group("payload", "tool", ("tool.m", "tool.mcx"), ("kg", "kg m"), np.eye(2), (0,))
    return RunsOf(group, np.zeros(2), Runs(H, h, unit, np.array([0.1, 0.1])), 1.0), unit


def test_the_unit_that_differs_is_named_and_its_logs_are_not():
    group, unit = units_of(np.random.default_rng(0), np.array([2.0, 0.0]))
    names = [f"{k}.csv" for k in range(10)]
    found = vary(names, [group], [f"arm-{u}" for u in range(5)])
    (odd,) = found.unlike_units
    assert (odd.run, odd.kind, odd.name) == (3, "payload", "tool.m")
    assert odd.value == pytest.approx(2.0, abs=0.3)
    assert not {3} & {unit[each.run] for each in found.unlike}
    (finding,) = [each for each in unlike_findings(found) if each.code == "unlike_unit"]
    assert finding.where == "unit arm-3"
    assert "more than in the other units; 4 other units predict" in finding.message
    assert finding.message.endswith("remove the load, or identify this robot alone")
    content = found.to_dict()
    assert [each["run"] for each in content["unlike_units"]] == ["arm-3"]
    single, _ = units_of(np.random.default_rng(0), np.array([9.0, 0.0]), units=7, runs=1)
    found = vary(names[:7], [single])
    assert [each.run for each in found.unlike_units] == [3]
    assert found.unlike == ()
    alike, _ = units_of(np.random.default_rng(1), np.zeros(2))
    assert vary(names, [alike], []).unlike_units == ()


def test_spread_of_drives_adds_to_the_covariance_of_the_fit():
    names = ["link.m", "b.coulomb", "a.viscous", "a.coulomb"]
    variation = {
        "parameters": {
            "a.viscous": {"spread": 0.5},
            "c.viscous": {"spread": 9.0},
            "b.coulomb": {"spread": 0.3, "spread_within_units": 0.4},
        },
        "correlation": [[1.0, 0.1, -0.6], [0.1, 1.0, 0.2], [-0.6, 0.2, 1.0]],
    }
    wanted = np.zeros((4, 4))
    wanted[2, 2], wanted[1, 1] = 0.25, 0.25
    wanted[1, 2] = wanted[2, 1] = -0.6 * 0.25
    assert between_covariance(variation, names) == pytest.approx(wanted, abs=1e-12)


def test_correlation_is_that_between_logs_or_between_units():
    group, unit = units_of(np.random.default_rng(2), np.zeros(2), units=6)
    drive = replace(group.group, kind="drive", parameters=("a.viscous", "a.coulomb"))
    found = vary([str(k) for k in range(12)], [replace(group, group=drive)])
    values = np.array([each.values for each in found.parameters])
    means = np.array([values[:, unit == u].mean(axis=1) for u in range(6)])
    assert found.correlation == pytest.approx(shrunk_correlation(means))
    one = replace(group.runs, unit=np.zeros(12, int))
    found = vary([str(k) for k in range(12)], [replace(group, group=drive, runs=one)])
    values = np.array([each.values for each in found.parameters])
    assert found.correlation == pytest.approx(shrunk_correlation(values.T))


def test_only_parameters_of_which_a_run_has_information_vary():
    rng = np.random.default_rng(6)
    group = stated("b", rng.normal(size=(5, 3)), 0.1)
    H = group.runs.H * np.diag([1.0, 0.0, 1.0])
    runs = replace(group.runs, H=H, h=np.einsum("kij,kj->ki", H, rng.normal(size=(5, 3))))
    found = vary(list("abcde"), (replace(group, runs=runs),)).parameters
    assert [each.name for each in found] == ["b.0", "b.2"]


def test_a_run_is_named_by_the_number_of_all_parameters_in_all_runs():
    """Groups of 1 and 2 parameters in 8 runs: 24 tests, so that p must be below 0.02 / 24."""
    rng = np.random.default_rng(3)
    x, others = rng.normal(size=(8, 1)), stated("b", rng.normal(size=(8, 2)), 0.1)
    named, p_values = [], []
    for x[7] in np.arange(2.0, 30.0, 1.0):
        group = stated("a", x, 0.1)
        compared = SpreadModel(group.runs).against_others(np.array([7]), is_unit=False)
        p_values.append(compared.mixture.beyond(compared.values).item())
        named.append([run.run for run in vary(list("abcdefgh"), (group, others)).unlike] == [7])
    assert named == [p < 0.02 / 24 for p in p_values]
    assert 0 < sum(named) < len(named)


@pytest.mark.parametrize(("kind", "centre"), [("drive", [3.0, 7.0]), ("gain", [1.0, 1.0]),
                                              ("payload", [0.0, 0.0])])  # fmt: skip
def test_an_unlike_run_has_value_error_and_interval_of_the_parameter_that_differs(kind, centre):
    rng, error, centre = np.random.default_rng(7), np.array([0.2, 0.05]), np.array(centre)
    x = [0.4, -0.3] + [0.3, 0.05] * rng.normal(size=(7, 2))
    x[5] += [0.1, 4.0]
    group = Group(kind, "b", ("b.x", "b.y"), ("N", "kg"), np.eye(2), (0,))
    H = np.tile(np.diag(error**-2.0), (7, 1, 1))
    runs = Runs(H, x / error**2, np.zeros(7, int), np.ones(2))
    found = vary(list("abcdefg"), (RunsOf(group, centre, runs, 1.0),))
    (odd,) = found.unlike
    assert (odd.run, odd.kind, odd.where, odd.name, odd.unit) == (5, kind, "b", "b.y", "kg")
    prediction = list(SpreadModel(runs.without(5)).predict())[1]
    shift = -prediction.mean if kind == "payload" else centre[1]
    assert odd.value == pytest.approx(shift + x[5, 1], abs=1e-2)
    assert odd.std_error == pytest.approx(error[1], rel=1e-4)
    assert odd.ends == pytest.approx(shift + prediction.ends, abs=0.1)  # and its own error
    assert np.ptp(odd.ends) > np.ptp(prediction.ends)
    (content,) = found.to_dict()["unlike"]
    assert (content["run"], content["ends"]) == ("f", odd.ends.tolist())
    if kind == "drive":
        entry = found.to_dict()["parameters"]["b.y"]
        assert entry["next_quantiles"] == sorted(entry["next_quantiles"])
        assert entry["next_quantiles"][7] == pytest.approx(entry["mean"], rel=0.1)
        assert entry["one_more"]["std_error"] < entry["std_error"]
        assert entry["by_log"][5] == pytest.approx(centre[1] + x[5, 1], abs=0.02)


def test_the_cause_of_an_unlike_unit_explains_most_of_all_its_runs():
    """Squares of 5000 and 1000, times information of 3 and 10; in the first run it is 1 and 8."""
    rng, unit = np.random.default_rng(7), np.array([0, 0, 1, 1, 2, 2, 3, 3, 3, 4, 4])

    def group(kind, square, first):
        x = 0.01 * rng.normal(size=(11, 1))
        x[unit == 3] += np.sqrt(square)
        H = np.ones((11, 1, 1))
        H[6] = first
        named = Group(kind, kind, (f"{kind}.x",), ("N",), np.eye(1), (0,))
        return RunsOf(named, np.zeros(1), Runs(H, H[:, 0] * x, unit, np.full(1, 0.1)), 1.0)

    pair = group("drive", 5000.0, 1.0), group("gain", 1000.0, 8.0)
    for groups in (pair, pair[::-1]):
        unlike = vary([str(k) for k in range(11)], groups).unlike_units
        assert [odd.kind for odd in unlike if odd.run == 3] == ["drive"]
