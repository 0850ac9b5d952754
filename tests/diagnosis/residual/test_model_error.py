"""Errors of drive parameters count what the model of the drives lacks, and what its shapes may be.

The truth of a parameter is that of the robot that made the log: Coulomb friction is what it is
without load, whether the model that is fitted knows of load friction or not.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.driven import ELBOW, LIFT, arm, driven, driven_log, found_in

from robotid.diagnosis.residual import model_error
from robotid.diagnosis.residual.drive_choice import choose_drives
from robotid.diagnosis.residual.misfit import find_misfits
from robotid.diagnosis.residual.model_error import settled_shapes, with_model_error
from robotid.diagnosis.residual.term_trials import take_sample
from robotid.dynamics.torque import trajectory_regressor
from robotid.estimation.fitting.drive_terms import DriveChoice, FoundShape, open_torques
from robotid.estimation.fitting.fitted import expected_band, friction_curve
from robotid.robot.drives import DriveMotion, LoadFriction, Stribeck, Tanh

QUANTILE = 1.5
PLAIN = "viscous+coulomb"


@pytest.fixture(scope="module")
def plain():
    return arm()


@pytest.fixture(scope="module")
def loaded(plain):
    """A robot whose elbow has load friction, its parameters by name, and its log."""
    true, pi = driven(plain, {ELBOW: [LoadFriction()]}, {f"{ELBOW}.load": 0.1})
    names = dict(zip(true.layout.names, pi, strict=True))
    return names, driven_log(true, pi, 3, reach=QUANTILE)


@pytest.fixture(scope="module")
def hooked(plain):
    true, pi = driven(plain, {ELBOW: [Stribeck(speed=0.1)]}, {f"{ELBOW}.stribeck": 3.0})
    names = dict(zip(true.layout.names, pi, strict=True))
    return names, driven_log(true, pi, 3, reach=QUANTILE)


@pytest.fixture(scope="module")
def fits(plain, request):
    """Fits of these robots by name and friction, each made when it is first asked for."""
    made = {}

    def fit(robot, friction):
        key = robot, str(friction)
        if key not in made:
            _, log = request.getfixturevalue(robot)
            slower = replace(log, t=1.4 * log.t, v=None, a=None)  # at other speeds, other loads
            made[key] = found_in(
                plain, [log], validation=[slower], friction=friction, estimator="wls"
            )
        return made[key]

    return fit


def at(found, name):
    return list(found.model.layout.names).index(name)


def test_coulomb_friction_that_stands_on_a_misfit_covers_the_truth(loaded, fits):
    true, found = loaded[0], fits("loaded", PLAIN)
    (misfit,) = found.misfits
    assert (misfit.joint, misfit.term.code) == (ELBOW, "load_friction")
    assert misfit.size == pytest.approx(0.1, abs=0.015)
    coulomb = f"{ELBOW}.coulomb"
    assert coulomb in found.on_misfit
    k, b = at(found, coulomb), found.mapping.base_names.index(coulomb)
    noise_alone = found.wls.std_error[b]
    miss = abs(found.standard[k] - true[coulomb])
    assert miss > 5.0 * noise_alone  # it took a part of the load's
    assert found.standard_error[k] > 5.0 * noise_alone
    assert miss < 1.96 * found.standard_error[k]
    assert found.base_interval[b, 0] < true[coulomb] < found.base_interval[b, 1]
    (said,) = [f for f in found.findings if f.code == "load_friction"]
    assert f"{coulomb} stand" in said.message or f"{coulomb}, " in said.message


def test_what_a_misfit_moves_is_what_a_fit_with_the_term_finds(fits):
    """The oracle: the same log fitted with the term."""
    found, better = fits("loaded", PLAIN), fits("loaded", {ELBOW: "load", "*": "none"})
    (misfit,) = found.misfits
    sample = take_sample(found)
    shift = sample.U.T @ misfit.shift  # base parameters
    for name in (f"{ELBOW}.coulomb", f"{ELBOW}.viscous", f"{LIFT}.coulomb"):
        b = found.mapping.base_names.index(name)
        moved = better.standard[at(better, name)] - found.standard[at(found, name)]
        assert shift[b] == pytest.approx(moved, abs=3.0 * better.standard_error[at(better, name)])
        before = found.wls.std_error[b]
        assert found.base_error[b] == pytest.approx(np.hypot(before, shift[b]), rel=1e-6)
        is_wide = found.base_error[b] > 1.3 * before
        assert (name in found.on_misfit) == is_wide


@pytest.mark.parametrize(("robot", "family"), [("loaded", "load"), ("hooked", "stribeck")])
def test_a_prediction_errs_by_what_a_missing_term_moves_and_by_its_torque(
    plain, robot, family, fits
):
    """The oracle: how much the prediction changes once the term is in the model."""
    joint = plain.joints.index(ELBOW)
    found, better = (fits(robot, x) for x in (PLAIN, {ELBOW: family, "*": "none"}))
    (term,) = (term for term in found.open_terms if term.joint == ELBOW)
    pure = found.standard_covariance - sum(np.outer(x.moves, x.moves) for x in found.open_terms)
    assert np.linalg.eigvalsh(pure).min() > -1e-9 * np.linalg.eigvalsh(pure).max()
    for one, other in zip(
        (*found.fitted, *found.validation), (*better.fitted, *better.validation), strict=True
    ):
        band = expected_band(found, one)
        changed = (other.torques["estimate"] - one.torques["estimate"])[band.samples, joint]
        W = trajectory_regressor(found.model, one.recording.trajectory.at(band.samples))
        W = W.reshape(len(band.samples), -1, W.shape[1])[:, joint]
        (torque,) = (
            z
            for x, z in zip(found.open_terms, open_torques(found, one, band.samples), strict=True)
            if x is term
        )
        errs = W @ term.moves + torque[:, joint]
        assert np.sqrt(np.mean((errs - changed) ** 2)) < 0.2 * np.sqrt(np.mean(changed**2))
        assert not torque[:, :joint].any()
        others = [x for x in found.open_terms if x is not term]
        wanted = np.einsum("ij,jk,ik->i", W, pure, W) + errs**2
        wanted += sum((W @ x.moves) ** 2 for x in others)
        np.testing.assert_allclose(band.parameters[:, joint] ** 2, wanted, rtol=1e-6)
    v = np.array([-1.0, -0.3, 0.3, 1.0])
    curves = [friction_curve(x, ELBOW, v, load=20.0) for x in (found, better)]
    changed = curves[1].torque - curves[0].torque
    np.testing.assert_allclose(curves[0].std, np.abs(changed), atol=0.3 * np.abs(changed).max())


def test_without_rows_to_judge_by_errors_stay_as_they_are(fits):
    found = fits("loaded", PLAIN)
    assert with_model_error(found, None, ()) == (found, ())
    assert found.mapping.names  # and with rows and no misfit they do, too
    same, on_misfit = with_model_error(found, take_sample(found), ())
    np.testing.assert_array_equal(same.base_error, found.base_error)
    assert on_misfit == ()


def test_errors_grow_by_the_squares_of_all_that_is_open(fits, rng):
    found = fits("loaded", PLAIN)
    sample, b = take_sample(found), len(found.base)
    shifts = rng.standard_normal((3, b))
    moved = [
        model_error._Move(joint, shift, lambda motion, alone: motion.v)
        for joint, shift in zip((ELBOW, LIFT, ELBOW), shifts, strict=True)
    ]
    wider = model_error._wider(found, sample, moved)
    X = shifts @ sample.U  # of base parameters
    np.testing.assert_allclose(wider.base_error**2, found.base_error**2 + np.sum(X**2, axis=0))
    terms = wider.open_terms[len(found.open_terms) :]
    assert [term.joint for term in terms] == [ELBOW, LIFT, ELBOW]
    moves = np.array([term.moves for term in terms])
    np.testing.assert_allclose(moves @ found.mapping.K.T, X, atol=1e-9 * np.abs(X).max())
    more = wider.standard_covariance - found.standard_covariance
    np.testing.assert_allclose(more, moves.T @ moves, atol=1e-9 * np.abs(more).max())
    assert model_error._wider(found, sample, []) is found


def test_an_error_of_a_shape_moves_parameters_as_refits_do(plain, hooked, fits):
    """The oracle: fits with the shape stated, larger and smaller by its standard error."""
    true, log = hooked
    found = fits("hooked", {ELBOW: "stribeck", "*": "none"})
    (choice,) = found.drives
    (shape,) = choice.shapes
    sure = {}
    for size in (shape.value - shape.std_error, shape.value, shape.value + shape.std_error):
        (term,) = choice.terms
        own = Stribeck(speed=size, data_range=term.data_range)
        model = plain.with_terms({ELBOW: [own]})
        sure[size] = found_in(model, [log], friction="none", estimator="wls")
    low, middle, high = sure.values()
    for term in ("stribeck", "coulomb", "viscous"):
        k = at(found, f"{ELBOW}.{term}")
        moved = 0.5 * (high.standard[k] - low.standard[k])
        wanted = np.hypot(middle.standard_error[k], moved)
        assert found.standard_error[k] == pytest.approx(wanted, rel=0.05), term
        by_one_error = found.open_terms[0].moves[k]  # of either sign
        assert abs(by_one_error) == pytest.approx(abs(moved), rel=0.1), term
        assert abs(found.standard[k] - true[f"{ELBOW}.{term}"]) < 2.6 * found.standard_error[k]
    k = at(found, f"{ELBOW}.stribeck")
    assert found.standard_error[k] > 1.1 * middle.standard_error[k]
    # the curve itself bends with the shape: at a speed it moves less or more than its parameters
    v = np.array([0.05, 0.1, 0.3, 1.0])
    curves = [friction_curve(x, ELBOW, v).torque for x in (low, high)]
    bent = 0.5 * (curves[1] - curves[0])
    wanted = np.hypot(friction_curve(middle, ELBOW, v).std, bent)
    np.testing.assert_allclose(friction_curve(found, ELBOW, v).std, wanted, rtol=0.05)


def test_shapes_that_err_together_have_one_covariance(fits):
    """A hook's speed and excess make up for each other: alone each looks far too sure."""
    found = fits("hooked", {ELBOW: "lugre", "*": "none"})
    (choice,) = found.drives
    C = np.array(choice.shape_covariance)
    np.testing.assert_allclose(np.sqrt(np.diag(C)), [s.std_error for s in choice.shapes])
    np.testing.assert_allclose(C, C.T)
    assert np.linalg.eigvalsh(C / np.sqrt(np.outer(np.diag(C), np.diag(C)))).min() > -1e-9
    speed, excess = 1, 2
    assert abs(C[speed, excess]) > 0.5 * np.sqrt(C[speed, speed] * C[excess, excess])


def test_shapes_are_settled_once_none_of_them_moves_by_a_fifth_of_its_error(fits, monkeypatch):
    found = fits("hooked", {ELBOW: "lugre", "*": "none"})
    (choice,) = found.drives
    values = np.array([shape.value for shape in choice.shapes])
    errors = 0.01 * values * [1.0, 2.0, 3.0]
    for shares, is_settled in (
        ([0.1, -0.19, 0.0], True), ([0.3, 0.0, -0.1], False), ([0.1, 0.0, -0.3], False),
    ):  # fmt: skip
        step = np.array(shares) * errors

        class Trial:
            def estimate(self, chosen, fitted, step=step):
                assert chosen == [0, 1, 2]
                return step, np.diag(errors**2)

        monkeypatch.setattr(model_error, "_shape_trial", lambda *args, trial=Trial: trial())
        moved = settled_shapes(found)
        assert (moved is None) == is_settled
        if moved is not None:
            np.testing.assert_allclose([s.value for s in moved[0].shapes], values + step)
            np.testing.assert_allclose([s.std_error for s in moved[0].shapes], errors)


def test_a_clean_robot_has_the_errors_of_its_noise(plain):
    true, pi = driven(plain, {}, {})
    found = found_in(
        plain, [driven_log(true, pi, 3, reach=QUANTILE)], friction=PLAIN, estimator="wls"
    )
    assert find_misfits(take_sample(found)) == found.misfits == ()
    np.testing.assert_allclose(found.base_error, found.wls.std_error)
    assert choose_drives(found, dict.fromkeys(found.model.joints, ())) == ()


def two_shapes():
    """Return a fit of two joints, the second of which has two terms with a shape each."""
    ranges = {"v": (0.02, 2.0), "q": (-1.0, 1.0)}
    terms = (Stribeck(data_range=ranges["v"], speed=0.2), Tanh(data_range=ranges["v"], speed=0.7))
    shapes = tuple(FoundShape(n, x, 0.1, "", False) for n, x in (("s", 0.2), ("t", 0.7)))
    choice = DriveChoice(
        "b", ("stribeck", "tanh"), terms, shapes=shapes, sizes=((0.2,), (0.7,)), data_range=ranges,
        shape_covariance=((0.04, 0.03), (0.03, 0.09)),
    )  # fmt: skip
    names = ("b.stribeck", "a.stribeck", "a.tanh", "b.tanh")
    layout = SimpleNamespace(names=names)
    standard = np.array([3.0, 70.0, 90.0, -2.0])
    return SimpleNamespace(model=SimpleNamespace(layout=layout), standard=standard), choice, ranges


def test_a_torque_changes_with_each_shape_as_differences_do(rng):
    found, choice, ranges = two_shapes()
    v = 2.0 * rng.standard_normal(30)
    motion = DriveMotion(*[np.zeros(30)] * 1, v, np.zeros(30), np.sign(v), *[np.zeros(30)] * 2)
    step = 1e-6

    def torque(k, sign):
        sizes = np.array([0.2, 0.7])
        sizes[k] += sign * step
        own = (
            Stribeck(data_range=ranges["v"], speed=sizes[0]),
            Tanh(data_range=ranges["v"], speed=sizes[1]),
        )
        return sum(x * t.column(motion) for x, t in zip((3.0, -2.0), own, strict=True))

    slopes = [(torque(k, 1) - torque(k, -1)) / (2 * step) for k in (0, 1)]
    for k in (0, 1):
        slope = model_error.shape_slope(found, choice, k, motion)
        np.testing.assert_allclose(slope, slopes[k], rtol=0.01, atol=1e-3)
    change = model_error._shape_change(found, choice, np.array([0.5, -2.0]), motion, None)
    np.testing.assert_allclose(change, 0.5 * slopes[0] - 2.0 * slopes[1], rtol=0.02, atol=3e-3)


def test_uncertain_shapes_are_directions_of_their_covariance(rng, monkeypatch):
    found, choice, _ = two_shapes()
    T = rng.standard_normal((5, 3))  # the last column is of the residual
    monkeypatch.setattr(model_error, "_shape_trial", lambda *_: SimpleNamespace(T=T))
    found.drives = (DriveChoice("a", (), ()), choice)
    moves = list(model_error._of_shapes(found, None, []))
    assert [move.joint for move in moves] == ["b", "b"]
    X = np.array([move.shift for move in moves])
    C = T[:, :2] @ np.array(choice.shape_covariance) @ T[:, :2].T
    np.testing.assert_allclose(X.T @ X, C, atol=1e-12)
    axes = np.array([move.torque.args[2] for move in moves])
    np.testing.assert_allclose(axes.T @ axes, choice.shape_covariance, atol=1e-12)
    np.testing.assert_allclose(X, -(axes @ T[:, :2].T))


def test_terms_that_were_nearly_selected_move_parameters_together(rng, monkeypatch):
    undecided = (Stribeck(speed=0.3), Tanh(speed=0.4))
    choices = (DriveChoice("a", (), ()), DriveChoice("b", (), (), undecided=undecided))
    v = rng.standard_normal((2, 12))
    still = np.zeros(12)

    def of(speed):
        return DriveMotion(still, speed, still, np.sign(speed), still, still)

    motions = [SimpleNamespace(of=lambda j, x=x: of(x) if j == 1 else None) for x in v]
    taken = (np.array([0, 5, 7]), np.array([2, 11]))
    sample = SimpleNamespace(joints=("a", "b"), taken=taken, of_joint=lambda j: ("of", j))
    T, theta, given = rng.standard_normal((4, 3)), np.array([1.5, -0.25]), []

    def trials(*arguments):
        given.append(arguments)
        return SimpleNamespace(whole=SimpleNamespace(T=T, parameters=lambda which: theta[which]))

    monkeypatch.setattr(model_error, "Trials", trials)
    (move,) = model_error._of_undecided(SimpleNamespace(drives=choices), sample, motions)
    ((own, Z),) = given
    assert own == ("of", 1)
    speed = np.concatenate([x[k] for x, k in zip(v, taken, strict=True)])
    columns = np.column_stack([term.column(of(speed)) for term in undecided])
    np.testing.assert_allclose(Z[:, 0], columns)
    assert move.joint == "b"
    np.testing.assert_allclose(move.shift, -T[:, :2] @ theta)
    wanted = 1.5 * undecided[0].column(of(v[0])) - 0.25 * undecided[1].column(of(v[0]))
    np.testing.assert_allclose(move.torque(of(v[0]), None), wanted)


@pytest.mark.parametrize(("shares", "is_settled"), [((0.3, 0.1), False), ((0.19, 0.1), True)])
def test_shapes_of_every_joint_must_settle(monkeypatch, shares, is_settled):
    _, choice, _ = two_shapes()
    choices = [replace(choice, joint="a"), DriveChoice("c", (), ()), choice]
    steps = {"a": shares[0], "b": shares[1]}
    error = 0.01

    def trial(found, choice, *_):
        step = error * np.array([steps[choice.joint], -0.05])
        return SimpleNamespace(estimate=lambda which, fitted: (step, error**2 * np.eye(2)))

    monkeypatch.setattr(model_error, "take_sample", lambda *_, **__: SimpleNamespace(fitted=6))
    monkeypatch.setattr(model_error, "_motions", lambda *_: [])
    monkeypatch.setattr(model_error, "_shape_trial", trial)
    moved = settled_shapes(SimpleNamespace(drives=choices))
    assert (moved is None) is is_settled
    if moved:
        first, same, last = moved
        assert same is choices[1]
        for found, share in ((first, shares[0]), (last, shares[1])):
            values = [shape.value for shape in found.shapes]
            assert values == pytest.approx([0.2 + error * share, 0.7 - 0.05 * error])


def test_drive_parameters_whose_error_grows_by_a_third_are_named(monkeypatch):
    """Not those of bodies, nor one without an error before."""
    before = SimpleNamespace(
        drives=(), standard_error=np.array([1.0, 1.0, 2.0, 3.0, np.inf, 2.0]),
        model=SimpleNamespace(layout=SimpleNamespace(n_inertial=2)),
        mapping=SimpleNamespace(names=tuple("abcdef")),
    )  # fmt: skip
    after = SimpleNamespace(standard_error=np.array([9.0, 1.0, 2.5, 4.0, np.inf, 9.0]))
    given = []

    def wider(found, sample, moves):
        given.append(list(moves))
        return after if len(given) == 3 else before

    monkeypatch.setattr(model_error, "_wider", wider)
    monkeypatch.setattr(model_error, "_of_misfit", lambda misfit: f"move of {misfit}")
    found, names = with_model_error(before, "sample", ["x", "y"])
    assert given == [[], [], ["move of x", "move of y"]]
    assert (found is after, names) == (True, ("d", "f"))


def test_a_fixed_parameter_moves_a_millionth_of_the_smallest_spread():
    given = []
    mapping = SimpleNamespace(gain=lambda spread: given.append(spread) or "gain")
    found = SimpleNamespace(prior_std=np.array([0.0, 2e-3, 5.0]), mapping=mapping)
    assert model_error._gain(found) == "gain"
    np.testing.assert_allclose(given, [[2e-9, 2e-3, 5.0]])
