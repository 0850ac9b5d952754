"""What torques consist of, against Pinocchio; and what residuals follow, where it is known."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from helpers.driven import ELBOW, EXACT, LIFT, WRIST, arm, driven, driven_log
from helpers.misfits import coloured
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.decisions import FEWEST, p_value
from robotid.diagnosis.residual.joint_torques import (
    JointTorque,
    Rows,
    _beyond_torque,
    _broadband_shares,
    even_bins,
    follow,
    joint_torques,
)
from robotid.dynamics.torque import joint_torque_regressor, predict, remember
from robotid.dynamics.torque_split import friction_split, split_torque
from robotid.estimation.fitting.evaluation import evaluate_logs
from robotid.estimation.fitting.recorded import hold_log
from robotid.robot.drives import Harmonic, Hat, Lag, LoadFriction, Presliding, Spring, Stribeck
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling


def states(model, rng, samples=7):
    """Random configurations, velocities and accelerations; a floating base turned at random."""
    n = model.n_rows
    q, v, a = (rng.uniform(-2, 2, (samples, k)) for k in (len(model.joints), n, n))
    if model.free_flyer:
        turned = rng.standard_normal((samples, 4))
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        q = np.hstack([rng.uniform(-1, 1, (samples, 3)), turned, q])
    return q, v, a


ROBOTS = {
    "fixed": lambda: RobotModel.from_urdf(example_urdf("ur5_robot.urdf")),
    "floating": lambda: RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), free_flyer=True),
    "coupled": lambda: RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"),
        couplings=(Coupling("wrist", (("wrist_1_joint", 1.0), ("wrist_2_joint", -0.7))),),
    ),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_the_parts_of_the_bodies_are_pinocchios(name, rng):
    model = ROBOTS[name]()
    pi, (q, v, a) = truth(model), states(model, rng)
    split = split_torque(model, pi, q, v, a)
    bodies, still = model.with_parameters(pi).pin_model, np.zeros(model.n_rows)
    data = bodies.createData()
    for k, x in enumerate(model.configurations(q)):
        gravity = pin.computeGeneralizedGravity(bodies, data, x)
        M = pin.crba(bodies, data, x)
        M = np.triu(M) + np.triu(M, 1).T
        velocity = pin.rnea(bodies, data, x, v[k], still) - gravity
        np.testing.assert_allclose(split.parts["gravity"][k], gravity, atol=1e-11)
        np.testing.assert_allclose(split.parts["inertia"][k], M @ a[k], atol=1e-11)
        np.testing.assert_allclose(split.parts["Coriolis"][k], velocity, atol=1e-11)


@pytest.mark.parametrize("is_possible", [True, False])
@pytest.mark.parametrize("name", ROBOTS)
def test_the_parts_sum_to_the_prediction(name, is_possible, rng):
    model = ROBOTS[name]()
    pi, (q, v, a) = truth(model), states(model, rng)
    if not is_possible:  # base parameters: first moments without a mass
        pi = pi * (rng.uniform(-1, 1, pi.shape) > 0.3)
    split = split_torque(model, pi, q, v, a)
    whole = (joint_torque_regressor(model, q, v, a) @ pi).reshape(v.shape)
    np.testing.assert_allclose(sum(split.parts.values()), whole, rtol=1e-12, atol=1e-11)
    rigid = np.where(np.arange(len(pi)) < model.layout.n_inertial, pi, 0.0)
    wanted = (joint_torque_regressor(model, q, v, a) @ rigid).reshape(v.shape)
    np.testing.assert_allclose(split.load, wanted, atol=1e-11)
    for row in range(model.n_rows):  # what drive parameters add, is what the drives' parts are
        every = [x for own in split.terms_of(row).values() for x in own.values()]
        drives = sum(every, start=np.zeros(len(q)))
        wanted = (sum(split.parts.values()) - split.load)[:, row]
        np.testing.assert_allclose(drives, wanted, atol=1e-11)


def test_every_kind_of_drive_term_has_its_part(rng):
    own = {
        LIFT: (LoadFriction(), Spring(), Harmonic(order=3.0), Lag()),
        ELBOW: (Stribeck(speed=0.3), Hat(number=1, at=0.2)),
        WRIST: (Presliding(displacement=0.05),),
    }
    sizes = {f"{LIFT}.load": 0.1, f"{LIFT}.spring": 7.0, f"{LIFT}.cos3": 2.0, f"{LIFT}.lag": 0.01}
    sizes |= {f"{ELBOW}.stribeck": 3.0, f"{ELBOW}.spring1": 4.0, f"{WRIST}.presliding": 1.0}
    model, pi = driven(arm(), own, sizes)
    motion = remember(model, process(driven_log(model, pi, 3, duration=4.0), EXACT))
    m = motion
    split = split_torque(model, pi, m.q, m.v, m.a, m.direction, m.memory)
    (whole,) = predict(model, [pi], m)
    scale = np.abs(whole).max()
    np.testing.assert_allclose(sum(split.parts.values()), whole, atol=1e-12 * scale)
    np.testing.assert_allclose(split.parts["spring"][:, 0], 7.0 * m.q[:, 0], atol=1e-12 * scale)
    wanted = 2.0 * np.cos(3 * m.q[:, 0])
    np.testing.assert_allclose(split.parts["ripple"][:, 0], wanted, atol=1e-12 * scale)
    index = list(model.layout.names).index
    armature, offset = (
        np.array([pi[index(f"{joint}.{term}")] for joint in model.joints])
        for term in ("armature", "offset")
    )
    np.testing.assert_allclose(split.parts["motor inertia"], armature * m.a, atol=1e-12 * scale)
    np.testing.assert_allclose(split.parts["offset"], offset + 0 * m.a, atol=1e-12 * scale)
    friction = [f"{LIFT}.{x}" for x in ("viscous", "coulomb", "load")]
    own = split.terms_of(0)["friction"]
    assert list(own) == friction
    wanted = sum(own[x] for x in friction)
    np.testing.assert_allclose(split.parts["friction"][:, 0], wanted, atol=1e-12 * scale)
    assert set(split.parts) == {
        "gravity", "inertia", "Coriolis", "motor inertia", "friction", "offset", "spring", "ripple",
        "delay",
    }  # fmt: skip
    assert np.abs(split.parts["delay"][:, 0]).max() > 0


def test_a_static_model_has_gravity_and_no_motion(rng):
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), dynamics="static")
    pi = truth(model)
    q, still, signs = rng.uniform(-2, 2, (5, 6)), np.zeros((5, 6)), np.ones((5, 6))
    split = split_torque(model, pi, q, still, still, signs)
    assert set(split.parts) == {"gravity", "friction", "offset"}
    whole = (joint_torque_regressor(model, q, still, still, signs) @ pi).reshape(q.shape)
    np.testing.assert_allclose(sum(split.parts.values()), whole, atol=1e-11)


def test_a_joint_is_judged_on_what_was_kept_apart(identified):
    kept, names = identified.validation[0], identified.model.row_names
    for j, torque in enumerate(joint_torques(identified)):
        measured = kept.metrics["estimate"].per_joint[names[j]]
        motion = kept.recording.trajectory
        assert torque.rows.recordings == (kept.recording.name,)
        wanted = (motion.tau - kept.torques["estimate"])[:, j]
        np.testing.assert_allclose(torque.residual, wanted, atol=1e-11)
        assert torque.rms["residual"] == pytest.approx(measured.rmse)
        expected = measured.rmse * 100 / measured.relative_error_pct
        assert torque.rms["measured"] == pytest.approx(expected)
        wanted = motion.tau[:, j]
        np.testing.assert_allclose(sum(torque.parts.values()) + torque.residual, wanted, atol=1e-11)
        # white noise is all that this log has beside its model
        assert torque.broadband > 0.5


def torque(residual, v, q, load, *, segments=16):
    """A joint whose residual is known; its friction is 10 N m."""
    N = len(residual)
    rows = Rows(
        ("log",), np.arange(N) / 100, np.zeros(N, int), np.zeros(N, int),
        None if segments is None else np.arange(N) * segments // N,
    )  # fmt: skip
    friction = 10 * np.sign(v)
    quantities = {
        "position": ("rad", q),
        "speed": ("rad/s", v),
        "acceleration": ("rad/s^2", np.gradient(v)),
        "load": ("N m", load),
    }
    return JointTorque(
        "elbow", "N m", rows, np.ones(N, bool), friction + residual, {"friction": friction},
        {"friction": {"elbow.coulomb": friction}}, quantities, 0.9,
    )  # fmt: skip


def test_recordings_have_pieces_of_their_own_and_follow_each_other_in_time():
    rows, starts = (37, 20, 5), (10.0, 3.0, 50.0)
    recording = np.repeat(np.arange(3), rows)
    t = np.concatenate([s + 0.1 * np.arange(n) for n, s in zip(rows, starts, strict=True)])
    found = Rows(("a", "b", "c"), t, recording, 0 * recording, None)
    pieces = [16 * k + (16 * i) // n for k, n in enumerate(rows) for i in range(n)]
    assert found.pieces.tolist() == pieces
    time = np.concatenate(
        [0.1 * np.arange(37), 3.6 + 0.1 * np.arange(20), 5.5 + 0.1 * np.arange(5)]
    )
    np.testing.assert_allclose(found.time, time)


def motion(rng, N=4000):
    """Speed, position and load that have nothing to do with each other, 40 s of them."""
    t = np.arange(N) / 100
    shift = rng.uniform(0, 6, (3, 4))
    f = rng.uniform(0.15, 1.0, (3, 4))
    return [np.sin(2 * np.pi * f[k] * t[:, None] + shift[k]).sum(axis=1) for k in range(3)]


@pytest.mark.parametrize("name", ["speed", "position", "load", "time", "constant"])
def test_what_a_residual_follows_is_found_with_its_share(name, rng):
    v, q, load = motion(rng)
    cause = {
        "speed": np.exp(-np.abs(v) / 0.3) * np.sign(v),
        "position": q,
        "load": np.abs(load),
        "time": np.linspace(-1, 1, len(v)),
        "constant": np.ones(len(v)),
    }[name]
    effect = cause - (name != "constant") * cause.mean()
    noise = rng.standard_normal(len(v))
    noise *= np.sqrt(np.mean(effect**2)) / np.std(noise)  # half of the square is the effect's
    found = torque(effect + noise, v, q, load)
    share = {d.name: d.share for d in found.follows}
    # bins take a part of it that their width blurs
    low = 0.35 if name in ("speed", "time") else 0.44
    assert low < share[name] < 0.53
    assert [d.name for d in found.follows if d.is_significant] == [name]
    said = found.sentence
    if name == "constant":
        assert re.search(r"4\d % of its power is a constant of (1|0.9\d|1.0) N m", said)
        assert "Zero the torque sensor" in said
    else:
        assert f"depends on the {name}, which explains" in said
    assert ("at low speed" in said) == (name == "speed")


def test_time_explains_what_the_best_quantity_leaves(rng):
    v, q, load = motion(rng)
    noise = 0.1 * rng.standard_normal(len(v))
    found = torque(2.0 * q + 0.3 * np.linspace(-1, 1, len(v)) + noise, v, q, load)
    residual, less = found.against_time
    (position,) = [d for d in found.follows if d.name == less == "position"]
    means = np.interp(q, position.centres, position.means)
    np.testing.assert_allclose(residual, found.residual - means)


def test_noise_of_any_colour_follows_nothing():
    rng, log_errors, tried, shares = np.random.default_rng(0), 0, 0, []
    for trial in range(60):
        v, q, load = motion(rng)
        noise = coloured(rng, (len(v),), (0, 5, 20)[trial % 3])
        found = torque(noise, v, q, load)
        log_errors += sum(d.is_significant for d in found.follows)
        tried += len(found.follows)
        shares.append([d.share for d in found.follows])
    assert log_errors <= 1, f"{log_errors} of {tried}"
    assert (np.mean(shares, axis=0) < 0).all(), "what was fitted to noise predicts no other noise"
    assert "is noise (90 % of its power is above the cut-off)" in found.sentence


def test_too_short_a_recording_says_so(rng):
    v, q, load = motion(rng, 300)
    found = torque(rng.standard_normal(300), v, q, load, segments=None)
    assert all(d.share is None for d in found.follows if d.name != "time")
    assert "the recordings are too short" in found.sentence


def test_what_is_forgotten_is_one_less_the_autocorrelation_of_all_recordings(rng):
    """Of two recordings of other rates, with gaps and rows left out; without a filter of a row."""
    shares = np.zeros((2, 3))  # products and squares
    evaluations = []
    for rate, cutoff, lag in ((100.0, 9.0, 11), (40.0, None, 1), (None, 5.0, 1)):
        r = rng.standard_normal((60, 3)).cumsum(axis=0) + 2.0
        mask, segment = rng.uniform(size=r.shape) < 0.8, np.repeat([0, 1], 30)
        mask[:, 2] = False  # a joint that does not move
        tau = rng.standard_normal(r.shape)
        recording = SimpleNamespace(
            trajectory=SimpleNamespace(tau=tau, segment=segment, rate=rate),
            signals=SignalSettings(cutoff=cutoff), mask=mask,
        )  # fmt: skip
        evaluations.append(SimpleNamespace(recording=recording, torques={"estimate": tau - r}))
        for j in range(3):
            for i in range(60 - lag):
                if mask[i, j] and mask[i + lag, j] and segment[i] == segment[i + lag]:
                    a, b = r[i, j], r[i + lag, j]
                    shares[:, j] += a * b, (a**2 + b**2) / 2
    *found, still = _broadband_shares(evaluations)
    np.testing.assert_allclose(found, 1.0 - shares[0, :2] / shares[1, :2])
    assert still is None


def test_a_cutoff_is_advised_above_which_the_torque_lacks_what_is_predicted(rng):
    """A torque that is filtered beside one of noise, in the longest segment of two recordings."""
    t = np.arange(3000) / 100.0
    slow, quick = np.sin(2 * np.pi * 0.6 * t), np.sin(2 * np.pi * 5.0 * t)
    noise = 0.3 * rng.standard_normal(len(t))
    tau = np.column_stack([3 * slow, slow + noise, 0 * t, slow])
    r = np.column_stack([0.2 * slow - 0.3 * quick, noise, 0 * t, 2 * slow + 2 * quick])
    segment = np.repeat([0, 1], [600, 2400])
    r[:600] = tau[:600]  # the shorter segment is not examined, and no row that is not used
    r[1000::97, 0] = 50.0
    evaluations = []
    for k in (slice(900), slice(3000)):
        motion = SimpleNamespace(t=t[k], tau=tau[k], segment=segment[k], rate=100.0)
        signals, mask = SignalSettings(cutoff=8.0), np.abs(r[k]) < 10.0
        recording = SimpleNamespace(trajectory=motion, signals=signals, mask=mask)
        evaluations.append(SimpleNamespace(recording=recording, torques={"estimate": (tau - r)[k]}))
    frequency, share = _beyond_torque(evaluations)
    assert 0.6 < frequency < 5.0
    np.testing.assert_allclose(share, [0.3**2 / (0.2**2 + 0.3**2), 0, 0, 0], atol=0.01)
    filtered = replace(torque(r[:, 0], slow, slow, slow), beyond=share[0], frequency=frequency)
    assert f"and 69 % of its power is above {frequency:.2g} Hz" in filtered.sentence
    assert f"Lower the cutoff in [signals], down to {frequency:.2g} Hz" in filtered.sentence
    assert "cutoff in" not in replace(filtered, beyond=0.2).sentence


def test_a_residual_is_examined_without_outliers_of_the_samples_used(rng):
    v, q, load = motion(rng)
    found = torque(0.5 * np.tanh(v) + 0.1 * rng.standard_normal(len(v)), v, q, load)
    used = np.arange(len(v)) % 4 != 1
    parts = {"friction": found.parts["friction"] + np.where(used, 0.0, 1e4)}
    tau = found.tau + np.where(np.arange(len(v)) % 400 == 0, 40.0, 0.0)
    spoilt = replace(found, used=used, parts=parts, tau=tau)
    r = spoilt.residual
    counted = used & (np.abs(r) <= 12 * np.median(np.abs(r[used])))
    assert (used & ~counted).sum() == 10
    segments = spoilt.rows.segments[counted]
    (speed,) = (d for d in spoilt.follows if d.name == "speed")
    wanted = follow("speed", "", v[counted], r[counted], even_bins(v[counted]), segments)
    np.testing.assert_allclose(speed.means, wanted.means)
    np.testing.assert_allclose(speed.centres, wanted.centres)
    assert (speed.share, speed.p_value) == (wanted.share, wanted.p_value)
    rms = spoilt.rms
    assert rms["measured"] == pytest.approx(np.sqrt(np.mean(tau[used] ** 2)))
    assert rms["residual"] == pytest.approx(np.sqrt(np.mean(r[used] ** 2)))


# --- how a residual follows a quantity, against sums over rows, bins and segments one by one ----
B, K, SIZE = 4, 7, 33  # bins, segments, rows of each


@pytest.fixture
def clustered(rng):
    """Values, residuals, bins and segments; two segments have a bin of their own alone."""
    x = rng.uniform(-1.0, 1.0, K * SIZE)
    bins = np.minimum(((x + 1.0) / 0.6).astype(int), B - 1)
    segments = 3 * np.repeat(np.arange(K), SIZE)  # numbers with gaps
    first = segments < 6
    bins[(bins == B - 1) & ~first] = B - 2
    r = 0.7 * x + 0.4 + rng.standard_normal(K)[segments // 3] + 0.1 * rng.standard_normal(len(x))
    return x, r, bins, segments


def test_means_and_errors_are_those_of_bins_of_clusters(clustered):
    x, r, bins, segments = clustered
    found = follow("speed", "rad/s", x, r, bins, segments)
    assert (found.name, found.unit) == ("speed", "rad/s")
    for b in range(B):
        own = bins == b
        assert found.centres[b] == pytest.approx(x[own].mean())
        assert found.means[b] == pytest.approx(r[own].mean())
        sums = [np.sum((r - r[own].mean())[own & (segments == k)]) for k in np.unique(segments)]
        there = sum((own & (segments == k)).any() for k in np.unique(segments))
        if there < 3:
            assert np.isnan(found.errors[b])
        else:
            wanted = np.sqrt(np.sum(np.square(sums)) * there / (there - 1)) / own.sum()
            assert found.errors[b] == pytest.approx(wanted)
    assert np.isnan(found.errors).tolist() == [False, False, False, True]


def test_the_share_is_of_stretches_that_the_means_do_not_know(clustered):
    x, r, bins, segments = clustered
    before, after = [], []
    for k in np.unique(segments):
        out, rest = segments == k, segments != k
        plain = r[rest].mean()
        means = [
            r[rest & (bins == b)].mean() if (rest & (bins == b)).any() else plain for b in range(B)
        ]
        before.append(np.sum((r[out] - plain) ** 2))
        after.append(np.sum((r[out] - np.array(means)[bins[out]]) ** 2))
    found = follow("speed", "rad/s", x, r, bins, segments)
    assert found.share == pytest.approx(1.0 - sum(after) / sum(before))
    assert found.p_value == pytest.approx(p_value(np.array(before), np.array(after), K))
    # a constant is compared with none
    constant = follow("constant", "", x, r, np.zeros(len(r), dtype=int), segments)
    left = sum(np.sum((r[segments == k] - r[segments != k].mean()) ** 2) for k in segments[::33])
    assert constant.share == pytest.approx(1.0 - left / np.sum(r**2))


def test_few_stretches_show_means_but_no_share(clustered):
    x, r, bins, segments = clustered
    few = segments < 3 * (FEWEST - 1)
    found = follow("speed", "rad/s", x[few], r[few], bins[few], segments[few])
    assert (found.share, found.p_value, found.is_significant) == (None, 1.0, False)
    assert np.isfinite(found.errors[:3]).all()
    none = follow("speed", "rad/s", x, r, bins, None)
    np.testing.assert_allclose(none.means, follow("speed", "", x, r, bins, segments).means)
    assert np.isnan(none.errors).all()
    assert (none.share, none.p_value) == (None, 1.0)


def test_a_dependence_is_significant_by_its_share_and_its_p_value(clustered):
    found = follow("speed", "rad/s", *clustered)
    for share, p, wanted in (
        (0.1, 2.9e-4, True), (0.099, 2.9e-4, False), (0.1, 3.1e-4, False), (None, 1e-4, False),
    ):  # fmt: skip
        assert replace(found, share=share, p_value=p).is_significant == wanted


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_it_is_off_most_where_the_mean_is_most_errors_from_zero(clustered, sign):
    """The largest means are of either sign; the last bin has no error."""
    x, r, bins, segments = clustered
    found = follow("speed", "rad/s", x, sign * r, bins, segments)
    ratio = np.where(np.isnan(found.errors), 0.0, np.abs(found.means) / found.errors)
    assert sorted(ratio)[-1] > 1.2 * sorted(ratio)[-2]
    assert found.where == found.centres[np.argmax(ratio)]
    mean, error = found.at(np.array([found.centres[0], 0.5 * sum(found.centres[:2]), -9.0, 9.0]))
    np.testing.assert_allclose(mean[:2], [found.means[0], 0.5 * sum(found.means[:2])])
    np.testing.assert_allclose(error[:2], [found.errors[0], 0.5 * sum(found.errors[:2])])
    assert np.isnan(mean[2:]).all()


def test_even_bins_have_as_many_rows_and_are_cut_at_zero(rng):
    x = rng.permutation(np.arange(100.0) - 34.5)
    bins = even_bins(x)
    assert np.bincount(bins).tolist() == [10, 10, 10, 5, 5, *[10] * 6]
    assert (np.diff(bins[np.argsort(x)]) >= 0).all()
    assert (x[bins <= 3] < 0).all()
    assert (x[bins > 3] > 0).all()
    assert np.unique(even_bins(np.ones(5))).tolist() == [0]


# --- friction against the truth -----------------------------------------------------------------
def test_friction_is_the_torque_that_viscous_coulomb_and_offset_add(ur5, rng):
    pi = truth(ur5)
    log = hold_log(ur5, exact_log(ur5, pi, rng), SignalSettings(cutoff=None))
    ((evaluation,), ()) = evaluate_logs([log], (), {"estimate": pi}, ur5.standard_parameters())
    left, friction = friction_split(ur5, evaluation.recording.trajectory, pi)
    value = dict(zip(ur5.layout.names, pi, strict=True))
    v = evaluation.recording.trajectory.v
    for j, name in enumerate(ur5.joints):
        known = (
            value[f"{name}.viscous"] * v[:, j]
            + value[f"{name}.coulomb"] * np.sign(v[:, j])
            + value[f"{name}.offset"]
        )
        np.testing.assert_allclose(friction[:, j], known, atol=1e-9)
        np.testing.assert_allclose(left[:, j], known, atol=1e-9)
