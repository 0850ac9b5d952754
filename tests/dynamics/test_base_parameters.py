from types import SimpleNamespace

import numpy as np
import pytest

from robotid.base.exceptions import DataError
from robotid.dynamics.base_parameters import base_mapping, structural_mapping
from robotid.dynamics.torque import joint_torque_regressor, random_regressor
from robotid.paper.planar_2r import urdf_text
from robotid.robot.drives import Cubic, Harmonic, Power, Tanh
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

ARM = {"panda.urdf": [f"panda_joint{i}" for i in range(1, 8)]}
COUNTS = {
    "ur3_robot.urdf": (36, None), "ur5_robot.urdf": (36, None), "ur10_robot.urdf": (36, None),
    "panda.urdf": (43, None), "xarm7.urdf": (43, None), "talos_full_v2.urdf": (290, 318),
    "a1.urdf": (68, 94), "go2.urdf": (68, 94), "solo12.urdf": (68, 94),
    "hyq_no_sensors.urdf": (68, 94), "g1_29dof_rev_1_0.urdf": (189, 213),
    "tiago_pro.urdf": (195, None), "pr2.urdf": (182, None),
    "so100.urdf": (36, None),  # two more only through rpy="1.5708" and the like
}  # fmt: skip


def count(path, **options):
    model = RobotModel.from_urdf(path, terms=(), **options)
    return len(structural_mapping(model).K)


@pytest.mark.parametrize(("name", "expected"), COUNTS.items(), ids=COUNTS)
def test_number_of_base_inertial_parameters(name, expected):
    fixed, floating = expected
    path = example_urdf(name)
    assert count(path, joints=ARM.get(name)) == fixed
    if floating is not None:
        assert count(path, free_flyer=True) == floating


def test_tx40_with_drives_and_the_wrist_coupling(recordings):
    coupling = Coupling("motor_6", (("joint_5", 1.0), ("joint_6", 1.0)))
    model = RobotModel.from_urdf(recordings / "tx40" / "robot.urdf", couplings=(coupling,))
    assert len(structural_mapping(model, inertial_only=True).K) == 36
    assert len(structural_mapping(model).K) == 61


def test_planar_arm_without_and_with_gravity(tmp_path):
    path = tmp_path / "planar_2r.urdf"
    path.write_text(urdf_text())
    assert count(path) == 4
    assert count(path, gravity=(-9.81, 0.0, 0.0)) == 6


def test_a_static_model_has_the_moments_that_gravity_loads_alone():
    assert count(example_urdf("ur10_robot.urdf"), dynamics="static") == 10  # two of five joints


def test_armature_adds_what_the_literature_says(ur5, panda):
    # UR: 36 + 4 = 40, Panda: 43 + 5 = 48, the rest is grouped with link inertias
    for model, expected in ((ur5, 40), (panda, 48)):
        arm = RobotModel.from_urdf(model.tree.path, joints=model.joints, terms=("armature",))
        assert len(structural_mapping(arm).K) == expected


def test_standard_parameters_come_back_from_base_ones(panda, rng):
    mapping = structural_mapping(panda)
    prior = panda.standard_parameters()
    beta = mapping.to_base(prior) + rng.standard_normal(len(mapping.K))
    for spread in (None, rng.uniform(0.1, 2.0, len(prior))):
        pi = mapping.to_standard(beta, prior, spread)
        np.testing.assert_allclose(mapping.to_base(pi), beta, rtol=0, atol=1e-11)
        # the nearest to the prior in units of the spread
        S = np.diag(np.ones(len(prior)) if spread is None else spread)
        nearest = prior + S @ np.linalg.pinv(mapping.K @ S) @ (beta - mapping.to_base(prior))
        np.testing.assert_allclose(pi, nearest, rtol=0, atol=1e-9)
    same = mapping.to_standard(mapping.to_base(prior), prior)
    np.testing.assert_allclose(same, prior, atol=1e-12)
    count = len(prior)
    with pytest.raises(DataError, match=rf"pi has shape \({count - 1},\), expected \({count},\)"):
        mapping.to_base(prior[1:])
    with pytest.raises(DataError, match=rf"the problem has 1 columns, expected the {count} of the"):
        mapping.reduce(SimpleNamespace(names=("a",)))


def test_the_choice_of_columns_does_not_depend_on_rounding(ur5):
    first = structural_mapping(ur5)
    samples = 2 * len(ur5.layout.names) // ur5.n_rows + 20
    W = random_regressor(ur5, samples, np.random.default_rng(0))
    noisy = W * (1 + 1e-14 * np.random.default_rng(1).standard_normal(W.shape))
    options = {"scales": ur5.layout.scales(ur5.length), "preference": ur5.layout.preference()}
    second = base_mapping(noisy, ur5.layout.names, **options)
    np.testing.assert_array_equal(first.independent, second.independent)


def test_a_column_of_rounding_noise_is_no_parameter():
    rng = np.random.default_rng(0)
    W = rng.standard_normal((50, 3)) * [1.0, 1e-16, 2.0]
    assert base_mapping(W, ("a.m", "b.m", "c.m")).base_names == ("a.m", "c.m")


def test_groups_read_like_formulas():
    rng = np.random.default_rng(0)
    W = rng.standard_normal((50, 2))
    W = np.column_stack([W, 0.5 * W[:, 0] - W[:, 1]])
    mapping = base_mapping(W, ("a.Izz", "b.m", "c.m"), preference=np.array([1.0, 1.0, 0.1]))
    assert mapping.expressions == ("a.Izz + 0.5 c.m", "b.m - c.m")


def test_further_terms_leave_the_base_parameters_of_the_others_as_they_are(rng):
    plain = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"))
    wave = [Harmonic(order=1.0), Harmonic(order=1.0, is_sine=True), Harmonic(order=2.0)]
    own = {"shoulder_pan_joint": wave[:1], "shoulder_lift_joint": wave, "elbow_joint": [Cubic()]}
    model = plain.with_terms(own)
    before, after = structural_mapping(plain), structural_mapping(model)
    # a torque that turns with the first joint that gravity loads is in sums with what hangs on it
    new = {"shoulder_pan_joint.cos1", "shoulder_lift_joint.cos2", "elbow_joint.cubic"}
    assert set(after.base_names) == set(before.base_names) | new
    told = dict(zip(after.base_names, after.expressions, strict=True))
    for name, expression in zip(before.base_names, before.expressions, strict=True):
        assert told[name].startswith(expression)
    q, v, a = rng.uniform(-2, 2, (3, 50, 6))
    W, pi = joint_torque_regressor(model, q, v, a), rng.standard_normal(len(model.layout.names))
    np.testing.assert_allclose(W[:, after.independent] @ after.to_base(pi), W @ pi, atol=1e-9)


def test_pivots_are_shares_of_the_largest_whatever_the_unit(rng):
    W = rng.standard_normal((60, 4)) * [100.0, 1.0, 10.0, 0.5]
    W = np.column_stack([W, W[:, 1] - 2.0 * W[:, 2]])
    names = tuple("abcde")
    for size in (1.0, 7e3):
        found = base_mapping(size * W, names)
        assert found.pivots[0] == 1.0
        assert (np.diff(found.pivots) <= 0).all()
        assert found.pivots[4] < 1e-12
        assert found.K.shape == (4, 5)
        pi = rng.standard_normal(5)
        np.testing.assert_allclose(W[:, found.independent] @ (found.K @ pi), W @ pi, atol=1e-9)


def test_further_terms_that_are_multiples_of_each_other_are_one_base_parameter(rng):
    """So slow that it is straight, a curve is a multiple of the speed."""
    own = {
        "elbow_joint": [Power(exponent=1.0), Tanh(speed=1e5)],
        "wrist_2_joint": [Cubic(), Power(exponent=3.0)],
    }
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), terms=("coulomb",), own_terms=own)
    plain, found = structural_mapping(model.with_terms({})), structural_mapping(model)
    assert len(found.K) == len(plain.K) + 2
    np.testing.assert_array_equal(structural_mapping(model, plain=plain).K, found.K)
    pi = rng.standard_normal(len(model.layout.names))
    pi[model.layout.names.index("elbow_joint.tanh")] = speed = 1e5
    q, v, a = rng.uniform(-2, 2, (3, 40, 6))
    W = joint_torque_regressor(model, q, v, a)
    torque, again = W @ pi, W[:, found.independent] @ found.to_base(pi)
    np.testing.assert_allclose(again, torque, atol=1e-7 * abs(torque).max())
    values = dict(zip(found.base_names, found.to_base(pi), strict=True))
    stated = dict(zip(model.layout.names, pi, strict=True))
    (name,) = {"elbow_joint.power", "elbow_joint.tanh"} & set(values)
    straight = stated["elbow_joint.power"] + 1.0  # [N m s/rad]
    assert values[name] == pytest.approx(straight * (speed if name.endswith("tanh") else 1.0))
