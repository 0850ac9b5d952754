from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.robot.parameters import (
    INERTIAL_TERMS,
    Coupling,
    ParameterLayout,
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    to_paper_order,
)


def test_order_is_pinocchios():
    inertia = pin.Inertia(2.0, np.array([0.1, 0.2, 0.3]), np.diag([1.0, 1.1, 1.2]))
    pi = dict(zip(INERTIAL_TERMS, inertia.toDynamicParameters(), strict=True))
    moved = inertia.matrix()[3:, 3:]  # inertia about the frame's origin
    assert pi["m"] == 2.0
    assert pi["mcy"] == pytest.approx(0.4)
    assert pi["Iyy"] == pytest.approx(moved[1, 1])
    assert pi["Ixz"] == pytest.approx(moved[0, 2])


def test_paper_order_is_that_of_equation_9():
    pi = np.arange(20.0)
    P = to_paper_order(pi)
    # [Ixx Ixy Ixz Iyy Iyz Izz mx my mz m]
    np.testing.assert_array_equal(P[:10], [4, 5, 7, 6, 8, 9, 1, 2, 3, 0])


def test_pseudo_inertia_is_pinocchios(rng):
    for _ in range(20):
        inertia = pin.Inertia.Random()
        pi = inertia.toDynamicParameters()
        expected = pin.PseudoInertia.FromInertia(inertia).toMatrix()
        np.testing.assert_allclose(pseudo_inertia(pi)[0], expected, atol=1e-14)
        np.testing.assert_allclose(inertial_from_pseudo_inertia(expected), pi, atol=1e-14)


def test_an_incomplete_body_is_refused():
    with pytest.raises(DataError, match=r"have shape \(13,\), wanted a vector of 10 per body"):
        pseudo_inertia(np.zeros(13))


def test_names_and_units_follow_the_layout():
    layout = ParameterLayout(
        bodies=("arm", "rod"),
        joints=("elbow", "slide"),
        couplings=(Coupling("motor", (("elbow", 1.0), ("slide", 2.0))),),
        prismatic=frozenset({"slide"}),
    )
    assert len(layout.names) == 20 + 8 + 3
    unit = dict(zip(layout.names, layout.units, strict=True))
    assert unit["arm.m"] == "kg"
    assert unit["arm.mcy"] == "kg m"
    assert unit["rod.Ixy"] == "kg m^2"
    assert unit["elbow.viscous"] == "N m s/rad"
    assert unit["slide.armature"] == "kg"
    assert unit["slide.coulomb"] == "N"
    assert "motor.offset" not in unit
    assert layout.is_nonnegative().sum() == 3 * 3


def test_a_coupling_may_stand_in_the_place_of_a_joints_own_drive():
    motor = Coupling("elbow", (("elbow", 1.0), ("wrist", -0.5)), replaces=True)
    layout = ParameterLayout(("a", "b"), ("elbow", "wrist"), couplings=(motor,))
    terms = ("armature", "viscous", "coulomb", "offset")
    assert layout.drive_names == tuple(f"{n}.{t}" for n in layout.joints for t in terms)
    np.testing.assert_array_equal(layout.drive_ratios, [[1.0, -0.5], [0.0, 1.0]])
    np.testing.assert_array_equal(layout.is_coupled, [True] * 3 + [False] * 5)
    with pytest.raises(SettingsError, match=r"coupling 'elbow' has the name of a joint or of"):
        replace(layout, couplings=(replace(motor, replaces=False),))
    with pytest.raises(SettingsError, match=r"coupling 'hip' has the joints hip, wanted joints"):
        replace(layout, couplings=(replace(motor, name="hip"),))


def test_a_coupling_of_an_unknown_joint_is_refused():
    with pytest.raises(SettingsError, match=r"coupling 'motor' has the joints wrist, wanted"):
        ParameterLayout(("a",), ("elbow",), couplings=(Coupling("motor", (("wrist", 1.0),)),))


def test_an_unknown_drive_term_is_refused():
    with pytest.raises(SettingsError, match="unknown drive terms stiction; known: armature"):
        ParameterLayout(("a",), ("elbow",), terms=("stiction",))


def test_a_slider_counts_by_its_stroke_and_a_coupling_by_the_mean_of_its_joints():
    ratios = (("a", 2.0), ("c", -0.5))
    options = {
        "bodies": ("x",),
        "couplings": (Coupling("motor", ratios),),
        "joints": ("a", "b", "c"),
    }
    layout = ParameterLayout(prismatic=frozenset("bc"), strokes={"c": 0.8}, **options)
    b, c = 1.0 / (2 * np.pi), 0.8 / (2 * np.pi)  # [m/s] that count as 1 rad/s; b states no stroke
    motor = (2.0 + 0.5 * c) / 2.5
    np.testing.assert_allclose(layout.drive_speeds, [1.0, b, c, motor])
    R = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, -0.5]])
    np.testing.assert_array_equal(layout.drive_ratios, R)
    owner = [name.split(".")[0] for name in layout.drive_names]
    places = [("a", "b", "c", "motor").index(name) for name in owner]
    np.testing.assert_array_equal(layout.drive_loads, R[places].T)
    shared = [name.startswith("motor.") for name in layout.drive_names]
    np.testing.assert_array_equal(layout.is_coupled, shared)
    assert "motor.offset" not in layout.drive_names
    own = [
        name for name, mine in zip(layout.names, layout.owned_by(["b", "x"]), strict=True) if mine
    ]
    assert own == [*layout.inertial_names, *(n for n in layout.drive_names if n.startswith("b."))]
    length = 0.4
    wanted = [1.0, *[0.4] * 3, *[0.16] * 6]
    wanted += [0.16 if n in ("a.armature", "motor.armature") else 1.0 for n in layout.drive_names]
    np.testing.assert_allclose(layout.scales(length), wanted)  # an armature of a slider is a mass
