from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.driven import ELBOW, JOINTS, LIFT, WRIST
from helpers.fitting import identify
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError
from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.fitting.drive_terms import OpenTerm
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.estimation.fitting.fitted import Fit, expected_band, friction_curve, next_errors
from robotid.estimation.fitting.standard_errors import TorqueBand, rms_error
from robotid.robot.drives import LoadFriction, PositionCoulomb
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

NOISE = np.array([2.0, 2.0, 1.0, 0.3, 0.3, 0.1])


@pytest.fixture(scope="module", params=["wls", "consistent"])
def found(request, ur5):
    rng = np.random.default_rng(3)
    pi = truth(ur5)
    fitted = exact_log(ur5, pi, rng, samples=1500, noise=NOISE)
    kept = exact_log(ur5, pi, rng, samples=1200, noise=NOISE)
    settings = SignalSettings(cutoff=None, trim=0.0)
    estimator = EstimatorSettings(request.param)
    return identify(ur5, [fitted], validation=[kept], signals=settings, estimator=estimator), pi


def test_bands_hold_95_percent_of_the_torques_of_a_new_motion(found):
    identification, _ = found
    (evaluation,) = identification.validation
    recording, band = evaluation.recording, identification.band(evaluation)
    share = band.coverage(recording.trajectory.tau, evaluation.torques["estimate"], recording.mask)
    assert ((share > 0.91) & (share < 0.99)).all(), share
    np.testing.assert_allclose(band.noise, NOISE, rtol=0.1)


def test_a_validation_log_that_was_fitted_has_the_noise_of_the_fitted_ones(found):
    identification, _ = found
    (kept,) = identification.validation
    again = replace(identification, validation=(replace(kept, is_refitted=True),))
    both = [(again.band(e), e) for e in (*again.fitted, *again.validation)]
    apart = [(identification.band(e), e) for e in (*identification.fitted, kept)]
    np.testing.assert_array_equal(both[0][0].noise, both[1][0].noise)
    for pairs in (both, apart[:1], apart[1:]):
        for j in range(6):  # the least that holds 95 % of the rows of all
            needed = []
            for band, e in pairs:
                k = band.samples
                residual = (e.recording.trajectory.tau - e.torques["estimate"])[k, j]
                used = e.recording.mask[k, j].astype(bool)
                needed.append(((residual / 1.96) ** 2 - band.parameters[:, j] ** 2)[used])
            wanted = np.sqrt(np.quantile(np.concatenate(needed), 0.95))
            assert pairs[0][0].noise[j] == pytest.approx(wanted)


def test_coverage_is_of_used_rows_and_a_row_on_the_edge_lies_in_the_band():
    band = TorqueBand(np.arange(3), np.zeros((3, 1)), np.ones(1))
    edge = 1.96 * np.array([[1.0 + 1e-12], [1.0 + 1e-6], [0.5]])
    assert band.coverage(edge, np.zeros((3, 1)), np.ones((3, 1), bool)) == pytest.approx(2 / 3)
    band = TorqueBand(np.array([0, 2]), np.zeros((2, 2)), np.ones(2))
    tau = np.array([[0.0, 9.0], [50.0, 50.0], [9.0, 9.0]])
    mask = np.array([[True, False], [True, True], [True, False]])
    np.testing.assert_array_equal(band.coverage(tau, np.zeros((3, 2)), mask), [0.5, np.nan])


def coupled_fit(rng, free_flyer=False):
    """Return what a fit of a drive of two joints to two logs has, all of it by chance."""
    model = RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"),
        joints=JOINTS,
        couplings=[Coupling("pair", ((LIFT, 1.0), (WRIST, -2.5)))],
        own_terms={"pair": [PositionCoulomb(centre=0.3)], ELBOW: [LoadFriction()]},
        free_flyer=free_flyer,
    )
    fitted, base = [], 6 * free_flyer
    for count in (31, 40):
        q, v, a, tau = rng.standard_normal((4, count, 3 + base))
        q = np.hstack([np.zeros((count, int(free_flyer))), q])  # a pose has seven numbers
        motion = Trajectory(
            np.arange(count) / 50, q, v, a, tau, JOINTS, 50.0, np.zeros(count, dtype=int)
        )
        mask = rng.random((count, 3 + base)) < 0.6
        # fast only where the other joint is not used
        mask[:2, -3:], v[:2] = [True, False, False], 9.0
        motion = replace(motion, v=v)
        fitted.append(SimpleNamespace(recording=SimpleNamespace(trajectory=motion, mask=mask)))
    size = len(model.layout.names)
    root = rng.standard_normal((size, size))
    standard = model.standard_parameters() + 0.1 * rng.random(size)
    return SimpleNamespace(
        model=model.with_reference(standard), fitted=fitted, standard=standard,
        standard_covariance=root @ root.T, open_terms=(),
    )  # fmt: skip


@pytest.mark.parametrize("free_flyer", [False, True])
def test_usual_friction_of_a_coupled_drive_is_over_the_rows_that_all_of_its_joints_have(
    rng, free_flyer
):
    found = coupled_fit(rng, free_flyer)
    ratios = np.array([1.0, 0.0, -2.5])
    rows = [(e.recording.mask[:, [-3, -1]]).all(axis=1) for e in found.fitted]
    motions = [(e.recording.trajectory, r) for e, r in zip(found.fitted, rows, strict=True)]
    q, v = (np.concatenate([getattr(m, x)[r, -3:] @ ratios for m, r in motions]) for x in "qv")
    assert 10 < len(q) < 40
    curve = Fit.friction(found, "pair")
    side = np.linspace(np.abs(v).min(), np.abs(v).max(), 20)
    np.testing.assert_allclose(curve.v, [*-side[::-1], *side], rtol=1e-12)
    names = [f"pair.{x}" for x in ("viscous", "coulomb", "coulomb_q1")]
    k = [found.model.layout.names.index(name) for name in names]
    sign = np.sign(curve.v)
    X = np.column_stack([curve.v, sign, sign * (np.median(q) - 0.3)])
    np.testing.assert_allclose(curve.torque, X @ found.standard[k], rtol=1e-12)
    C = found.standard_covariance[np.ix_(k, k)]
    np.testing.assert_allclose(curve.std, np.sqrt([x @ C @ x for x in X]), rtol=1e-12)
    np.testing.assert_array_equal(curve.half_width, 1.96 * curve.std)
    assert curve.load == 0.0
    # of stated speeds and position
    asked = Fit.friction(found, "pair", [0.7, -0.2], q=1.1, load=3.0)
    X = np.array([[0.7, 1.0, 0.8], [-0.2, -1.0, -0.8]])
    np.testing.assert_allclose(asked.torque, X @ found.standard[k], rtol=1e-12)
    assert asked.load == 3.0
    assert repr(Fit.friction(found, "pair", [])) == "<FrictionCurve: no speeds>"
    assert repr(Fit.friction(found, "pair", [1 / 3])).endswith("1 speeds, 0.3333 to 0.3333>")


def test_usual_friction_that_depends_on_the_load_is_that_at_its_rms_over_the_rows_used(rng):
    found, loads = coupled_fit(rng), []
    size = found.model.layout.n_inertial
    for e in found.fitted:
        m = e.recording.trajectory
        bodies = joint_torque_regressor(found.model, m.q, m.v, m.a)[:, :size]
        loads.append((bodies @ found.standard[:size]).reshape(-1, 3)[e.recording.mask[:, 1], 1])
    curve = Fit.friction(found, ELBOW, [0.4])
    assert curve.load == pytest.approx(np.sqrt(np.mean(np.concatenate(loads) ** 2)))
    for wrong, words in (
        ({"load": np.inf}, "load is 'inf', expected a finite number or None"),
        ({"q": "up"}, "q is 'up', expected a finite number or None"),
        ({"v": [[0.1, 0.2]]}, r"v has shape \(1, 2\), expected finite speeds, shape \(k,\)"),
        ({"v": [0.1, np.inf]}, r"v has shape \(2,\), expected finite speeds"),
        ({"joint": "elbow"}, r"'elbow' is no drive of .*; drives: .*pair"),
    ):
        with pytest.raises(DataError, match=words):
            Fit.friction(found, **{"joint": ELBOW, "v": [0.1], **wrong})
    for e in found.fitted:
        e.recording.trajectory = replace(e.recording.trajectory, v=0.0 * e.recording.trajectory.v)
    with pytest.raises(DataError, match="elbow_joint was at rest in the fitted logs, so the range"):
        Fit.friction(found, ELBOW)


def test_a_term_that_is_open_adds_its_own_torque_to_what_it_moves(rng):
    found, v = coupled_fit(rng), np.array([-0.8, 0.3, 1.7])
    layout = found.model.layout
    names = [f"{ELBOW}.{x}" for x in ("viscous", "coulomb", "offset", "load")]
    k = [layout.names.index(name) for name in names]
    C = np.diag(rng.random(len(layout.names)) + 1.0)
    moves = 0.3 * rng.standard_normal((2, len(C)))
    C += moves.T @ moves
    own = [OpenTerm(ELBOW, moves[0], lambda drive, motion: drive.v**3),
           OpenTerm(LIFT, moves[1], lambda drive, motion: drive.v**2)]  # fmt: skip
    found = replace_in(found, standard_covariance=C, open_terms=tuple(own))
    curve = friction_curve(found, ELBOW, v, load=-2.0)
    X = np.column_stack([v, np.sign(v), np.ones(3), 2.0 * np.sign(v)])
    np.testing.assert_allclose(curve.torque, X @ found.standard[k], rtol=1e-12)
    alone = np.diag(C - moves.T @ moves)[k]
    variance = X**2 @ alone + (X @ moves[0, k] + v**3) ** 2 + (X @ moves[1, k]) ** 2
    np.testing.assert_allclose(curve.std, np.sqrt(variance), rtol=1e-12)
    assert curve.load == -2.0


def replace_in(found, **changes):
    return SimpleNamespace(**{**vars(found), **changes})


def test_the_band_of_a_recording_has_each_open_term_with_what_it_moves(rng):
    """diag(W C W^T) + sum (W x + z)^2, the torque z of a term at its own joint only."""
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), joints=JOINTS)
    q, v, a, tau = rng.standard_normal((4, 9, 3))
    motion = Trajectory(np.arange(9) / 50, q, v, a, tau, JOINTS, 50.0, np.zeros(9, dtype=int))
    mapping, size = structural_mapping(model), model.layout.n_inertial
    standard = model.standard_parameters() * rng.uniform(0.5, 2.0, len(model.layout.names))
    root, moves, again = (rng.standard_normal((k, len(standard))) for k in (40, 2, 3))
    own = [
        OpenTerm(LIFT, moves[0], lambda drive, alone: drive.v**3 + alone.a),
        OpenTerm(WRIST, moves[1], lambda drive, alone: drive.load * alone.others[ELBOW].q),
    ]
    found = SimpleNamespace(
        model=model, mapping=mapping, standard=standard, open_terms=tuple(own),
        standard_covariance=root.T @ root + moves.T @ moves + again.T @ again,
        estimate=SimpleNamespace(sigma=np.array([3.0, 1.0, 0.5])), repeated=again.T @ again,
    )  # fmt: skip
    recording = SimpleNamespace(trajectory=motion, signals=SignalSettings(cutoff=5.0))
    evaluation = object.__new__(Evaluation)
    vars(evaluation).update(recording=recording)
    band = expected_band(found, evaluation)
    Y = joint_torque_regressor(model, q, v, a)
    load = (Y[:, :size] @ standard[:size]).reshape(9, 3)
    W, z = Y[:, mapping.independent] @ mapping.K, np.zeros((2, 9, 3))
    z[0, :, 0], z[1, :, 2] = v[:, 0] ** 3 + a[:, 0], load[:, 2] * q[:, 1]
    variance = np.sum((W @ root.T) ** 2, axis=1)
    variance += (W @ moves[0] + z[0].ravel()) ** 2 + (W @ moves[1] + z[1].ravel()) ** 2
    np.testing.assert_array_equal(band.samples, np.arange(9))
    np.testing.assert_allclose(band.parameters, np.sqrt(variance).reshape(9, 3), rtol=1e-9)
    np.testing.assert_allclose(band.total**2, band.parameters**2 + [9.0, 1.0, 0.25], rtol=1e-12)
    other = rng.standard_normal((30, len(standard)))  # as much as the next log may differ
    wide = expected_band(found, evaluation, other.T @ other)
    more = np.sum((W @ other.T) ** 2, axis=1).reshape(9, 3)
    np.testing.assert_allclose(wide.parameters**2, band.parameters**2 + more, rtol=1e-9)
    short = replace(wide, samples=wide.samples[:4], parameters=wide.parameters[:4])
    squares = np.vstack([wide.total, short.total]) ** 2
    np.testing.assert_allclose(rms_error([wide, short]), np.sqrt(squares.mean(axis=0)))
    after = replace_in(found, between=other.T @ other, fitted=[evaluation])
    np.testing.assert_allclose(next_errors(after), np.sqrt(np.mean(wide.total**2, axis=0)))
