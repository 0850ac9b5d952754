"""Which directions data determine: closed forms, brute force, and one answer everywhere."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.fitting import fit, identify
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import RankDeficientError
from robotid.base.findings import listed
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process, resolve
from robotid.diagnosis.logs.motion_checks import check_excitation
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.estimators.determination import (
    Combination,
    Determination,
    Group,
    base_spread,
    determine,
)
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.output.files.entries import build_result
from robotid.output.report.tables import open_section

EXACT = SignalSettings(cutoff=None, trim=0.0)
NOISE = 0.1  # [N m]
CHOICE = EstimatorSettings()  # intervals are not read


def moved(model, change, *, samples=600, noise=NOISE):
    """Return a log of a motion that was changed, with its own torques and noise."""
    rng = np.random.default_rng(1)
    log = exact_log(model, truth(model), rng, samples=samples)
    q, v, a = (np.array(x) for x in (log.q, log.v, log.a))
    change(log.t, q, v, a)
    tau = (joint_torque_regressor(model, q, v, a) @ truth(model)).reshape(q.shape)
    tau += noise * rng.standard_normal(q.shape)
    return Log(t=log.t, q=q, v=v, a=a, tau=tau, joints=log.joints)


def still_wrist(t, q, v, a):
    q[:, 5], v[:, 5], a[:, 5] = 0.3, 0.0, 0.0


def pan_one_way(t, q, v, a):
    """The first joint turns one way only, now faster, now slower."""
    q[:, 0], v[:, 0], a[:, 0] = 0.5 * t - 0.3 * np.cos(t), 0.5 + 0.3 * np.sin(t), 0.3 * np.cos(t)


@pytest.fixture(scope="module")
def wrist(ur5):
    return identify(ur5, [moved(ur5, still_wrist)], signals=EXACT, estimator=CHOICE)


@pytest.fixture(scope="module")
def pan(ur5):
    return identify(ur5, [moved(ur5, pan_one_way)], signals=EXACT, estimator=CHOICE)


def test_a_sum_that_alone_is_measured_is_named_as_such():
    known = determine(["x.coulomb", "x.offset", "y.m"], np.diag([9.0, 0, 9])[:, [0, 0, 2]], 5 * ONE)
    assert known.rank == 2
    assert known.undetermined == ("x.coulomb", "x.offset")
    assert known.described() == (
        "x.coulomb and x.offset are identifiable only as x.coulomb + x.offset"
    )
    ((group,),) = [known.to_list()]
    assert group["determined"][0]["terms"] == pytest.approx({"x.coulomb": 1.0, "x.offset": 1.0})


ONE = np.ones(3)


def test_units_and_scales_do_not_matter():
    rows, spread = np.array([[3.0, 6e3, 0.0], [0.0, 0.0, 40.0]]), np.array([1.0, 1e-3, 0.1])
    scale = np.array([1.0, 1e-3, 1e4])  # of other units
    one, other = (determine("abc", rows * s, spread / s) for s in (ONE, scale))
    assert one.rank == other.rank == 2
    np.testing.assert_allclose(one.shrinkage, other.shrinkage)
    # 3 a + 6000 b is measured; b leads, for its share of the sum is the largest
    assert str(one.groups[0].combinations[0]) == "b + 0.0005 a"
    assert str(other.groups[0].combinations[0]) == "b + 0.5 a"


def test_words_name_the_four_largest_terms_of_a_sum_by_their_shares():
    names, factors = tuple("abcdefg"), (-20.0, 0.5, 1.0, 1.0, 3.14159, -1.0, 7.0)
    shares = (0.3, -0.2, 1.0, 0.9, 0.051, 0.4, 0.05)
    sums = [Combination(names[:k], factors[:k], shares[:k]) for k in range(3, 8)]
    assert list(map(str, sums)) == [
        "c - 20 a + 0.5 b", "c + d - 20 a + 0.5 b", "c + d - 20 a + 0.5 b + ...",
        "c + d - f - 20 a + ...", "c + d - f - 20 a + ...",
    ]  # fmt: skip
    assert str(Combination(names[2:5], factors[2:5], shares[2:5])) == "c + d + 3.14 e"
    # g is too small to be a term, whatever its factor
    assert str(Combination(("c", "g"), (1.0, 7.0), (1.0, 0.05))) == "c"


def grouped(size, count):
    names = tuple(f"p{k}" for k in range(size))
    return Group(names, tuple(Combination(names[k : k + 1], (1.0,), (1.0,)) for k in range(count)))


def test_words_of_groups_say_how_many_sums_are_determined():
    said = [str(grouped(*sizes)) for sizes in ((2, 0), (2, 1), (5, 2), (4, 3), (6, 1), (1, 0))]
    assert said == [
        "p0 and p1 are not identifiable", "p0 and p1 are identifiable only as p0",
        "p0, p1, p2, p3 and p4 are identifiable only as p0 and p1",
        "the 4 parameters p0 ... p3 are identifiable only in 3 sums, as p0",
        "the 6 parameters p0 ... p5 are identifiable only in 1 sum, as p0",
        "p0 is not identifiable",
    ]  # fmt: skip
    a, b = Group(("x",), ()), Group(("y", "z"), ())
    one, two, three, four = (grouped(size, 1) for size in (2, 3, 4, 5))
    names = ("x", "y", "z", "p0", "p1", "p2", "p3", "p4", "alone")

    def known(*groups):
        return Determination(names, np.ones(9), np.ones(9), np.zeros((9, 4)), groups)

    found = known(a, one, two, b, three, four)
    assert found.merged == (one, two, three, four, Group(("x", "y", "z"), ()))
    nothing = "x, y and z are not identifiable"
    assert found.described() == f"{one}; {two}; 2 more groups of this kind; {nothing}"
    assert known(one, two, three).described() == f"{one}; {two}; 1 more group of this kind"
    assert known(two, a).described() == f"{two}; x is not identifiable"
    assert found.rank == 5
    assert found.undetermined == names[:-1]
    assert known().merged == ()
    assert known().described() == ""
    error = RankDeficientError(3, ("x",), 9)
    assert known().refusal(error) is error
    said = found.refusal(error)
    assert (said.rank, said.undetermined) == (5, names[:-1])
    assert f"{one}; {two}; 2 more groups of this kind" in str(said)


@pytest.mark.parametrize(("noise", "is_determined"), [(1.0, True), (2.0, True), (2.2, False)])
def test_a_parameter_is_determined_if_its_spread_shrinks_by_a_tenth(noise, is_determined):
    # 1 / sqrt(1 + 1 / noise^2) = 0.9 at a noise of 2.06 spreads
    known = determine(["a"], np.array([[1.0 / (3.0 * noise)]]), np.array([3.0]))
    assert known.shrinkage[0] == pytest.approx(1 / np.sqrt(1 + noise**-2))
    assert known.rank == int(is_determined)
    assert known.undetermined == (() if is_determined else ("a",))


def test_what_is_pinned_counts_as_known():
    K, spread = np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, 2.0, 1.0])
    np.testing.assert_allclose(base_spread(K, spread), [5.0, 1.0])
    before = base_spread(K, spread, [False, True, True])
    np.testing.assert_allclose(before, [3.0, 0.0])
    known = determine(["a", "b"], np.zeros((2, 2)), before)
    assert known.rank == 1
    assert known.undetermined == ("a",)


@pytest.mark.parametrize("seed", range(5))
def test_named_sums_hold_along_every_direction_the_data_leave_open(seed):
    rng = np.random.default_rng(seed)
    b, rank = 12, 8
    spread = 10.0 ** rng.uniform(-3, 2, b)
    N = rng.standard_normal((b, b - rank)) * (rng.uniform(size=(b, b - rank)) < 0.4)
    A = rng.standard_normal((30, b))
    A = 50 * (A - A @ N @ np.linalg.pinv(N)) / spread
    names = [f"p{i}" for i in range(b)]
    known = determine(names, A, spread)
    assert known.rank == np.linalg.matrix_rank(A)
    named = set()
    for combination in [c for group in known.groups for c in group.combinations]:
        places = [names.index(name) for name in combination.names]
        moved_by = np.array(combination.coefficients) @ (spread[:, None] * N)[places]
        terms = np.abs(combination.coefficients) * spread[places]
        assert np.abs(moved_by).max() < 0.01 * terms.max()
        named |= set(combination.names)
    # the rest holds by itself
    alone = [i for i, name in enumerate(names) if name not in known.undetermined]
    assert np.abs(known.weak[alone]).max(initial=0) < 0.31
    # as many independent sums and single ones as the rank
    sums = sum(len(group.combinations) for group in known.groups)
    assert sums + len(alone) == known.rank


def test_moving_along_a_weak_direction_changes_no_torque_and_no_named_sum(ur5, wrist):
    known, mapping = wrist.determination, wrist.mapping
    e = wrist.fitted[0]
    motion, mask = e.recording.trajectory, e.recording.mask
    W = joint_torque_regressor(ur5, motion.q, motion.v, motion.a)[:, mapping.independent]
    W = W[mask.astype(bool).reshape(-1)]  # the rows that were fitted
    assert known.rank == np.linalg.matrix_rank(W / np.linalg.norm(W, axis=0).clip(1e-9), tol=1e-6)
    places = {name: k for k, name in enumerate(known.names)}
    assert len(known.weak.T) == 11
    for weak in known.weak.T:
        change = known.spread * weak  # one plausible spread
        assert np.abs(W @ change).max() < 1e-9
        for c in [c for group in known.groups for c in group.combinations]:
            terms = [places[name] for name in c.names]
            size = np.abs(np.array(c.coefficients) * known.spread[terms]).max()
            assert abs(np.array(c.coefficients) @ change[terms]) < 0.01 * size
    strong = np.ones(58) - known.weak @ known.weak.sum(axis=0)  # any other direction shows
    assert np.abs(W @ (known.spread * strong)).max() > 1.0


def test_a_joint_that_turns_one_way_leaves_friction_and_offset_a_sum(pan):
    known = pan.determination
    assert known.undetermined == ("shoulder_pan_joint.coulomb", "shoulder_pan_joint.offset")
    assert known.rank == 57
    assert known.described() == (
        "shoulder_pan_joint.coulomb and shoulder_pan_joint.offset are identifiable only as "
        "shoulder_pan_joint.coulomb + shoulder_pan_joint.offset"
    )
    # the sum is found, the terms are not
    pi = truth(pan.model)
    at = [pan.model.layout.names.index(f"shoulder_pan_joint.{x}") for x in ("coulomb", "offset")]
    assert pan.standard[at].sum() == pytest.approx(pi[at].sum(), abs=0.15)
    of_sum = np.sqrt(pan.standard_covariance[np.ix_(at, at)].sum())
    assert pan.standard_error[at].min() > 10.0 * of_sum


@pytest.mark.parametrize("case", ["wrist", "pan"])
def test_doctor_result_report_and_refusal_say_the_same(ur5, case, request):
    found = request.getfixturevalue(case)
    known = found.determination
    assert known.undetermined == found.estimate.undetermined  # of the consistent fit itself
    structure = build_result(found, {})["structure"]
    assert structure["rank"] == known.rank
    assert structure["undetermined"] == list(known.undetermined)
    sums = [entry for group in structure["indistinguishable"] for entry in group["determined"]]
    html = open_section(found).replace("<wbr>", "")
    assert f"The data determine {known.rank} of 58 base parameters" in html
    for entry in sums:
        assert entry["text"] in html
    assert known.rank == len(known.names) - len(known.undetermined) + len(sums)
    reasons = found.verdict.reasons
    assert any(listed(known.undetermined, 8) in reason for reason in reasons)

    log = found.fitted[0].recording.log
    with pytest.raises(RankDeficientError) as caught:
        fit(ur5, [log], signals=EXACT, estimator="wls")
    assert caught.value.rank == known.rank
    assert caught.value.undetermined == known.undetermined
    assert known.described() in str(caught.value)

    motion = process(log, resolve(log, EXACT))
    mapping = structural_mapping(ur5)
    (finding,) = check_excitation(ur5, mapping, [motion], EXACT, "run.csv")
    assert finding.severity == "warning"
    assert finding.evidence["rank"] == known.rank
    assert known.described() in finding.message
    assert "no action needed" not in finding.message


def test_few_rows_of_a_long_motion_tell_the_doctor_the_same(ur5, monkeypatch):
    log = moved(ur5, lambda *motion: None)
    motion, mapping = process(log, resolve(log, EXACT)), structural_mapping(ur5)

    def weakest():
        (finding,) = check_excitation(ur5, mapping, [motion], EXACT, "run.csv")
        assert finding.severity == "note"
        assert finding.message.endswith("no action needed")
        return finding.evidence["weakest"]

    whole = weakest()
    monkeypatch.setattr("robotid.diagnosis.logs.motion_checks._ROWS", 120)
    assert weakest() == pytest.approx(whole, rel=0.25)


def test_an_ill_conditioned_motion_is_not_passed_over(ur5, monkeypatch):
    log = moved(ur5, lambda *motion: None)
    motion, mapping = process(log, resolve(log, EXACT)), structural_mapping(ur5)
    monkeypatch.setattr("robotid.estimation.estimators.determination._ILL_CONDITIONED", 1.0)
    (finding,) = check_excitation(ur5, mapping, [motion], EXACT, "run.csv")
    assert "no action needed" not in finding.message
    assert finding.severity == "note"
    assert (
        "% of its prior standard deviation; to determine it better, record a motion of all joints"
        in finding.message
    )


def test_what_is_lost_in_the_noise_of_a_rich_motion_is_a_note(ur5):
    log = moved(ur5, lambda *motion: None, noise=10.0)
    motion, mapping = process(log, resolve(log, EXACT)), structural_mapping(ur5)
    (finding,) = check_excitation(ur5, mapping, [motion], EXACT, "run.csv")
    assert finding.severity == "note"
    assert finding.evidence["rank"] < 58
    assert finding.evidence["condition"] < 100
    assert "not identifiable above the noise; a faster motion determines more" in finding.message


def test_too_few_rows_are_said(ur5):
    log = moved(ur5, lambda *motion: None, samples=9)
    motion, mapping = process(log, resolve(log, EXACT)), structural_mapping(ur5)
    (finding,) = check_excitation(ur5, mapping, [motion], EXACT, "run.csv")
    assert finding.severity == "warning"
    assert "torque rows for 58 parameters: too few rows to fit" in finding.message


def test_a_pinned_link_is_not_listed(ur5, wrist):
    log = wrist.fitted[0].recording.log
    settings = replace(wrist.estimator, constraints={"pinned": ["wrist_3_link"]})
    found = fit(ur5, [log], signals=EXACT, estimator=settings)
    own = found.mapping.described([f"wrist_3_link.{term}" for term in ("mcx", "Ixy", "Ixz", "Iyz")])
    assert len(own["alone"]) == 4
    assert not set(own["alone"]) & set(found.determination.undetermined)
    assert set(own["alone"]) & set(wrist.determination.undetermined)
    assert "wrist_3_joint.viscous" in found.determination.undetermined
    assert found.determination.undetermined == found.estimate.undetermined


def test_one_measured_sum_of_four_makes_one_group_of_them():
    """Three directions are open: none of the other parameters is among them."""
    rows = 50.0 * np.array(
        [[0.0, 1.0, 1.0, 0.0, -1.0, 1.0], [1.0, 0, 0, 0, 0, 0], [0, 0, 0, 1.0, 0, 0]]
    )
    spread = np.array([1.0, 2.0, 2.0, 3.0, 2.0, 2.0])
    found = determine(tuple("abcdef"), rows, spread)
    (group,) = found.groups
    assert group.names == ("b", "c", "e", "f")
    (one,) = group.combinations
    assert (one.names, one.coefficients) == (("b", "c", "e", "f"), pytest.approx((1, 1, -1, 1)))
    assert one.shares == pytest.approx((1, 1, -1, 1))
    assert found.rank == 3
    size = 50.0 * np.array([np.sqrt(4 * 2.0**2), 1.0, 3.0])
    np.testing.assert_allclose(found.shrinkage, [*np.sort(1 / np.hypot(1, size)), 1, 1, 1])


def test_a_sum_of_parameters_of_other_spreads_has_physical_coefficients():
    """0.5 a - 4 b is measured: in units of the spreads 1 and -0.8."""
    spread = np.array([2.0, 0.2])
    found = determine(("a", "b"), 90.0 * np.array([[0.5, -4.0]]), spread)
    (group,) = found.groups
    (one,) = group.combinations
    assert one.coefficients == pytest.approx((1.0, -8.0))
    assert one.shares == pytest.approx((1.0, -0.8))
