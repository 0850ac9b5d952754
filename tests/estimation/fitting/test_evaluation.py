from types import SimpleNamespace

import numpy as np
from helpers.synthetic import exact_log, truth

from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.estimation.fitting.evaluation import (
    TorqueSums,
    _joined,
    evaluate_logs,
    hidden_joints,
    predict,
    shares_rows,
)
from robotid.estimation.fitting.recorded import hold_log

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)


def evaluated(model, log, parameters, prior):
    """Return the evaluation of one log in memory."""
    ((found,), ()) = evaluate_logs([hold_log(model, log, EXACT)], (), parameters, prior)
    return found


def test_baselines_are_the_urdf_with_and_without_motion(ur5, rng):
    pi, prior = truth(ur5), ur5.standard_parameters()
    found = evaluated(ur5, exact_log(ur5, pi, rng), {"truth": pi}, prior)
    recording = found.recording
    assert set(found.torques) == {"truth", "urdf", "gravity_only"}
    np.testing.assert_allclose(found.torques["truth"], recording.trajectory.tau, atol=1e-10)
    (urdf,) = predict(ur5, [prior], recording.trajectory)
    np.testing.assert_allclose(found.torques["urdf"], urdf, rtol=1e-12, atol=1e-12)
    # a vertical axis carries no weight
    assert np.abs(found.torques["gravity_only"][:, 0]).max() < 1e-9
    measured = found.metrics["truth"].per_joint["elbow_joint"]
    assert measured.relative_error_pct < 1e-9
    assert measured.baselines["gravity_only"] > 10


def test_without_parameters_there_are_recordings_but_no_predictions(ur5, rng):
    own, other = (hold_log(ur5, exact_log(ur5, truth(ur5), rng), EXACT) for _ in range(2))
    (fitted,), kept = evaluate_logs([own], [other, own], {}, None)
    assert [e.is_refitted for e in kept] == [False, True]
    for e in (fitted, *kept):
        assert e.torques == e.sums == e.metrics == {}
    # not copied: what was computed of the motion is there for all that follows
    assert fitted.recording.trajectory is own.whole.trajectory


def test_each_kept_log_is_looked_for_in_each_fitted_one(ur5, rng):
    a, b, new = (hold_log(ur5, exact_log(ur5, truth(ur5), rng), EXACT) for _ in range(3))
    for fitted in ([a, b], [b, a]):
        _, kept = evaluate_logs(fitted, [b, new, a], {}, None)
        assert [e.is_refitted for e in kept] == [True, False, True]


def test_joints_are_hidden_whose_torque_changes_less_over_the_rows_used_than_is_left():
    model = SimpleNamespace(is_static=True, row_names=tuple("abcd"), row_units=("N m",) * 4)
    k = np.arange(40)
    way = (-1.0) ** k[:, None]  # of a mean of 0, and of size 1

    def evaluation(mean, used):
        torque = mean + way * [1.0, 1.0, 2.1, 1.0]
        torque[k % 4 > 1, 0] += 90.0  # where no row is used
        mask = np.column_stack([used, used | True, used | True, used & False])
        left = 2.0 * (-1.0) ** (k[:, None] // 2)
        sums = TorqueSums.of(torque + left, torque, mask, {})
        return SimpleNamespace(
            torques={"estimate": torque}, sums={"estimate": sums},
            recording=SimpleNamespace(mask=mask),
        )  # fmt: skip

    logs = [evaluation(np.array([0.0, mean, 0.0, 0.0]), k % 4 <= 1) for mean in (-1.8, 1.8)]
    assert hidden_joints(model, logs) == ("a",), "the second's stands differ from log to log"
    assert hidden_joints(model, logs[:1]) == ("a", "b"), "the fourth has no row"
    full = SimpleNamespace(is_static=False, row_names=model.row_names, row_units=model.row_units)
    assert hidden_joints(full, logs) == ()


def test_rows_recorded_twice_are_found_whatever_the_clock_says(ur5, rng):
    log, other = (exact_log(ur5, truth(ur5), rng) for _ in range(2))
    later = Log(t=log.t + 5.0, q=log.q, tau=log.tau, joints=log.joints)
    part = later.window(8.0, 9.0)
    assert shares_rows(part, log)
    assert not shares_rows(other, log)
    before, after = log.window(end=6.0), log.window(start=6.0)
    assert before.t[-1] == after.t[0]  # both hold the row where they meet
    assert not shares_rows(after, before)
    still = [np.repeat(x[:1], 400, axis=0) for x in (log.q, log.tau)]
    two = (
        Log(
            0.01 * np.arange(400 + len(x.t)),
            *map(np.vstack, zip(still, (x.q, x.tau), strict=True)),
            log.joints,
        )
        for x in (log, other)
    )
    assert not shares_rows(*two)  # both are at rest in one pose first
    jittered = Log(t=log.t, q=log.q, tau=log.tau * (1 + 1e-12), joints=log.joints)
    assert not shares_rows(jittered, log)


def test_parts_of_a_log_keep_the_gaps_between_them(rng):
    q = rng.standard_normal((3, 5, 2))
    segments = ([0, 0, 1, 1, 3], [3, 3, 4, 4, 4], [9, 9, 9, 9, 9])
    motions = [
        Trajectory(k + np.arange(5) / 10.0, x, x, x, x, ("a", "b"), 10.0, np.array(segment))
        for k, (x, segment) in enumerate(zip(q, segments, strict=True))
    ]
    whole = _joined(motions)
    assert whole.segment.tolist() == [0, 0, 1, 1, 2, 3, 3, 4, 4, 4, 5, 5, 5, 5, 5]
    np.testing.assert_array_equal(whole.q, np.concatenate(q))
    np.testing.assert_array_equal(whole.t, np.concatenate([m.t for m in motions]))
