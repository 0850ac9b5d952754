"""Friction on the terms of simulators: brute force over the rows, bounds, what is left."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from helpers.robots import motion

from robotid.base.exceptions import DataError
from robotid.dynamics.friction_projection import DriveMoments, drive_moments, project_friction
from robotid.dynamics.torque import remember, trajectory_regressor
from robotid.robot.drives import Asymmetric, Harmonic, Lag, LoadFriction, Presliding, Stribeck
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

LIFT, ELBOW, WRIST = "shoulder_lift_joint", "elbow_joint", "wrist_1_joint"
OWN = {
    LIFT: (LoadFriction(),),
    ELBOW: (Stribeck(data_range=(0.05, 2.0), speed=0.3), Asymmetric()),
    WRIST: (Harmonic(data_range=(-3.0, 3.0), order=2.0),),
}
VALUES = {
    f"{LIFT}.load": 0.08, f"{LIFT}.coulomb": 3.0, f"{LIFT}.viscous": 4.0,
    f"{ELBOW}.coulomb": 9.0, f"{ELBOW}.stribeck": -6.0, f"{ELBOW}.viscous": 2.0,
    f"{ELBOW}.asymmetric": 0.7, f"{ELBOW}.offset": 0.4,
    f"{WRIST}.cos2": 1.5, f"{WRIST}.coulomb": 0.6,
}  # fmt: skip


@pytest.fixture
def case(ur5):
    """A robot, its parameters, two recordings of unlike length and their rows used."""
    model = ur5.with_terms(OWN)
    pi = model.standard_parameters()
    for name, value in VALUES.items():
        pi[model.layout.names.index(name)] = value
    model, rng = model.with_reference(pi), np.random.default_rng(4)
    recordings = []
    for count in (300, 120):
        m = remember(model, motion(model, rng, count))
        tau = (trajectory_regressor(model, m) @ pi).reshape(m.q.shape)
        mask = np.abs(m.v) > 0.3
        mask[: count // 3, 1] = False
        recordings.append((replace(m, tau=tau), mask))
    return model, pi, recordings


def torque_and_columns(model, pi, recordings, joint):
    """Return a joint's friction and offset over its rows, and v, sign(v), q, 1 there."""
    j = model.joints.index(joint)
    own = [k for k, n in enumerate(model.layout.names) if n.startswith(f"{joint}.")]
    own = [k for k in own if not model.layout.names[k].endswith("armature")]
    y, v, q = [], [], []
    for m, mask in recordings:
        W = trajectory_regressor(model, m).reshape(*m.v.shape, -1)[:, j]
        y.append((W[:, own] @ pi[own])[mask[:, j]])
        v.append(m.v[mask[:, j], j])
        q.append(m.q[mask[:, j], j])
    y, v, q = (np.concatenate(x) for x in (y, v, q))
    return y, {"viscous": v, "coulomb": np.sign(v), "spring": q, "offset": np.ones_like(v)}


@pytest.mark.parametrize("onto", [("viscous", "coulomb", "offset"), ("viscous", "coulomb"),
                                  ("viscous", "coulomb", "offset", "spring")])  # fmt: skip
def test_it_is_the_nearest_friction_over_the_rows(case, onto):
    model, pi, recordings = case
    projection = project_friction(model, pi, drive_moments(model, recordings), onto)
    assert [drive.name for drive in projection.drives] == [LIFT, ELBOW, WRIST]
    assert projection.drives[1].replaced == ("stribeck", "asymmetric")
    for drive in projection.drives:
        y, columns = torque_and_columns(model, pi, recordings, drive.name)
        used = [n for n in ("viscous", "coulomb", "spring") if n in onto]
        if drive.name != WRIST:  # nothing else depends on the position
            used = [n for n in used if n != "spring"]
        A = np.column_stack([*(columns[n] for n in used), columns["offset"]])
        low = [0.0] * len(used) + [-np.inf]
        best = scipy.optimize.lsq_linear(A, y, (low, np.inf), method="bvls")
        wanted = dict(zip([*used, "offset"], best.x, strict=True))
        assert drive.error == pytest.approx(np.sqrt(2.0 * best.cost / len(y)), rel=1e-6)
        assert set(drive.values) == {n for n in wanted if n in onto}
        for name, value in drive.values.items():
            assert value == pytest.approx(wanted[name], abs=1e-9), (drive.name, name)
        j = model.joints.index(drive.name)
        tau = np.concatenate([m.tau[mask[:, j], j] for m, mask in recordings])
        assert drive.torque == pytest.approx(np.sqrt(np.mean(tau**2)))
    names = projection.model.layout.names
    assert not any(name.endswith(("load", "stribeck", "asymmetric", "cos2")) for name in names)
    for k, name in enumerate(names):  # all else stays
        joint, _, term = name.rpartition(".")
        if joint not in OWN or term in ("armature", *(() if "offset" in onto else ("offset",))):
            assert projection.pi[k] == pi[model.layout.names.index(name)]


def test_friction_that_would_be_negative_is_0_and_the_rest_is_fitted_again(case):
    model, pi, recordings = case
    pi = pi.copy()
    for name, value in {f"{ELBOW}.coulomb": 0.5, f"{ELBOW}.viscous": 0.1}.items():
        pi[model.layout.names.index(name)] = value
    moments = drive_moments(model, recordings)
    drive = project_friction(model, pi, moments, ("viscous", "coulomb", "offset")).drives[1]
    assert drive.values["coulomb"] == 0.0
    assert not drive.transfer[1].any()
    y, columns = torque_and_columns(model, pi, recordings, ELBOW)
    A = np.column_stack([columns["viscous"], columns["offset"]])
    (viscous, offset), *_ = np.linalg.lstsq(A, y, rcond=None)
    assert drive.values["viscous"] == pytest.approx(viscous, rel=1e-8)
    assert drive.values["offset"] == pytest.approx(offset, rel=1e-8)


def test_the_moments_are_read_back_and_the_sentence_states_the_figures(case):
    model, pi, recordings = case
    moments = drive_moments(model, recordings)
    assert moments[ELBOW].terms == (
        "viscous", "coulomb", "offset", "stribeck", "asymmetric", "spring"
    )  # fmt: skip
    again = {name: DriveMoments.from_dict(m.to_dict()) for name, m in moments.items()}
    first, second = (project_friction(model, pi, m, ("viscous", "coulomb"))
                     for m in (moments, again))  # fmt: skip
    np.testing.assert_array_equal(first.pi, second.pi)
    drive = first.drives[1]
    assert str(drive) == (
        f"elbow_joint: stribeck, asymmetric projected on viscous {drive.values['viscous']:.4g} "
        f"N m s/rad, coulomb {drive.values['coulomb']:.4g} N m; error {drive.error:.3g} N m RMS "
        f"({100 * drive.error / drive.torque:.2g} % of its torque)"
    )
    assert drive.to_dict()["error"] == drive.error
    broken = moments[ELBOW].to_dict() | {"terms": ["viscous"]}
    with pytest.raises(DataError, match=r"shape \(6, 6\), expected a finite matrix over the 1"):
        DriveMoments.from_dict(broken)


def test_a_delay_stays_by_itself_and_presliding_is_that_of_long_motion(case, ur5):
    _, _, recordings = case
    model = ur5.with_terms({ELBOW: (Lag(), Presliding(displacement=0.02))})
    pi, names = model.standard_parameters(), list(model.layout.names)
    values = {"lag": 0.01, "presliding": 3.0, "coulomb": 2.0, "viscous": 1.0, "offset": 0.1}
    for term, value in values.items():
        pi[names.index(f"{ELBOW}.{term}")] = value
    moments = drive_moments(model.with_reference(pi), recordings)
    found = project_friction(model, pi, moments, ("viscous", "coulomb", "offset"))
    (drive,) = found.drives
    assert drive.replaced == ("presliding",)
    wanted = {"viscous": 1.0, "coulomb": 5.0, "offset": 0.1}
    assert drive.values == pytest.approx(wanted, abs=1e-9)
    assert drive.error == pytest.approx(0.0, abs=1e-6)
    steady = "presliding at steady value, without the transient after reversals"
    assert str(drive) == (
        "elbow_joint: presliding projected on viscous 1 N m s/rad, coulomb 5 N m, offset 0.1 N m; "
        f"error below 0.01 % of its torque; {steady}"
    )
    mixed = replace(drive, replaced=("stribeck", "presliding"), error=0.3, torque=10.0)
    assert str(mixed).endswith(f"; error 0.3 N m RMS (3 % of its torque); {steady}")
    other = replace(drive, replaced=("stribeck",), error=3e-16, torque=10.0)
    assert str(other).endswith("; error below 0.01 % of its torque")
    left = dict(zip(found.model.layout.names, found.pi, strict=True))
    assert left[f"{ELBOW}.lag"] == 0.01
    assert f"{ELBOW}.presliding" not in left


def test_moments_of_a_drive_of_several_joints_are_of_rows_that_all_of_them_use():
    ratios = (("elbow_joint", 2.0), ("wrist_1_joint", -0.5))
    joints = ["shoulder_lift_joint", "elbow_joint", "wrist_1_joint"]
    model = RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"), joints=joints, couplings=(Coupling("motor", ratios),),
        own_terms={"motor": (Harmonic(data_range=(-9.0, 9.0), order=2.0),)},
    )  # fmt: skip
    rng, recordings, rows = np.random.default_rng(3), [], []
    for count in (90, 31):
        m = motion(model, rng, count)
        mask = rng.random((count, 3)) < 0.6
        recordings.append((m, mask))
        both = mask[:, 1] & mask[:, 2]
        assert 0 < both.sum() < (mask[:, 1] | mask[:, 2]).sum()
        w, z = (2.0 * x[both, 1] - 0.5 * x[both, 2] for x in (m.v, m.q))
        rows.append((np.column_stack([w, np.sign(w), np.cos(2 * z), np.ones_like(w), z]),
                     m.tau[both, 1:]))  # fmt: skip
    [(name, found)] = drive_moments(model, recordings).items()
    assert name == "motor"
    X, tau = (np.concatenate(x) for x in zip(*rows, strict=True))
    order = [found.terms.index(t) for t in ("viscous", "coulomb", "cos2", "offset", "spring")]
    assert len(found.terms) == 5
    np.testing.assert_allclose(found.products[np.ix_(order, order)], X.T @ X / len(X), atol=1e-12)
    assert found.torque == pytest.approx(np.sqrt(np.sum(tau**2) / len(X)))
    x = {"viscous": 0.7, "cos2": -1.3, "spring": 0.2}
    torque = X @ [0.7, 0.0, -1.3, 0.0, 0.2]
    assert found.rms(x) == pytest.approx(np.sqrt(np.mean(torque**2)))
    wanted = np.linalg.lstsq(X[:, [0, 3]], X[:, [2, 4]], rcond=None)[0]
    np.testing.assert_allclose(
        found.transfer(("cos2", "spring"), ("viscous", "offset")), wanted, atol=1e-9
    )
