"""A stated mass verifies the torque scale only where torque determines that mass."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.crane import CRANE
from helpers.driven import arm
from helpers.fitting import fit
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.verdict.scale_check import (
    StatedMass,
    check_scale,
    determines_total_mass,
    stated_mass,
)
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.robot.model import RobotModel

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0, velocity="measured")


def checked(model, log, **constraints):
    settings = EstimatorSettings(constraints=constraints)
    return check_scale(fit(model, [log], signals=EXACT, estimator=settings))


@pytest.fixture(scope="module")
def lifted():
    """A fixed arm of revolute joints, whose first link can have any mass: model, truth, log."""
    model = arm()
    pi = truth(model)
    pi[: model.layout.n_inertial] *= 0.75
    return model, pi, exact_log(model, pi, np.random.default_rng(0), samples=300, noise=0.3)


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    """A cart on a rail without motor inertia, so that the rail's force determines all mass."""
    path = tmp_path_factory.mktemp("crane") / "crane.urdf"
    path.write_text(CRANE)
    model = RobotModel.from_urdf(path, terms=("viscous",))
    pi = truth(model)
    return model, pi, exact_log(model, pi, np.random.default_rng(0), samples=300, noise=0.05)


@pytest.mark.parametrize("times", [1.0, 2.0])
def test_any_total_mass_of_a_fixed_arm_fits_and_none_verifies(lifted, times):
    model, pi, log = lifted
    total = float(pi[: model.layout.n_inertial : 10].sum())
    free, found = checked(model, log), checked(model, log, total_mass=times * total)
    assert not free.is_total_determined
    assert found.stated.ratio is None
    assert found.masses[1] == pytest.approx(times * total)  # it was taken, but no torque changed
    assert found.factor == pytest.approx(free.factor, rel=0.05)
    assert (found.stated.verifies, found.stated.contradicts) == (False, False)
    assert found.contradicts is found.has_one_factor
    assert model.layout.bodies[0] in found.stated.absorbed_by
    assert [x.to_dict()["is_stated"] for x in (free, found)] == [False, True]
    assert "The stated total_mass does not verify the scale: torque does not" in found.message
    assert "Verify it with a payload of known mass (robotid payload)" in found.message


def test_the_named_links_take_up_most_of_the_likeliest_change_that_no_torque_shows():
    model = arm()
    layout, K = model.layout, structural_mapping(model).K
    spread = np.full(len(layout.names), 0.2)
    spread[: layout.n_inertial : 10] = 0.9, 0.35, 1.5  # [kg]
    known = SimpleNamespace(theta=np.zeros(len(K)), covariance=np.eye(len(K)))
    bounds = SimpleNamespace(masses={}, total=(5.0, 5.0), pinned=())
    found = SimpleNamespace(
        model=model, wls=known, prior_std=spread, prior=np.zeros(len(spread)),
        mapping=SimpleNamespace(K=K), estimator=SimpleNamespace(bounds=bounds),
    )  # fmt: skip
    # the change x of least |x / spread| with K x = 0 that adds 1 kg to the total mass
    own = np.array([name.endswith(".m") for name in layout.names], dtype=float)
    rows = np.vstack([K, own]) * spread
    x = spread * (np.linalg.pinv(rows) @ np.append(np.zeros(len(K)), 1.0))
    masses = np.abs(x[: layout.n_inertial : 10])
    wanted = tuple(np.array(layout.bodies)[masses > 0.1 * masses.sum()].tolist())
    assert np.linalg.norm(K @ x) < 1e-9
    assert stated_mass(found) == StatedMass(("total_mass",), absorbed_by=wanted)


def test_the_force_of_a_rail_verifies_a_total_mass_and_contradicts_a_wrong_one(crane):
    model, pi, log = crane
    total = float(pi[0] + pi[10])
    assert checked(model, log).is_total_determined
    right, wrong = (checked(model, log, total_mass=x * total) for x in (1.0, 2.0))
    assert right.stated.ratio == pytest.approx(1.0, abs=right.stated.half_width)
    assert 0.001 < right.stated.half_width < 0.03
    assert wrong.stated.ratio == pytest.approx(right.stated.ratio / 2)
    assert wrong.stated.half_width == pytest.approx(right.stated.half_width / 2)
    assert (right.agrees, right.contradicts) == (True, False)
    assert (wrong.agrees, wrong.contradicts) == (False, True)
    assert right.message.startswith("absolute scale verified by a stated mass")
    assert "torque alone determines 0.499 +- 0.0022 x the stated total_mass" in wrong.message
    assert "probable cause: the gains of the torques, or the stated mass" in wrong.message


def test_stated_masses_of_all_links_add_up_to_one_that_torque_determines(crane):
    model, pi, log = crane
    alone = checked(model, log, mass={"boom": float(pi[10])}).stated
    both = checked(model, log, mass={"boom": float(pi[10]), "cart": float(pi[0])}).stated
    total = checked(model, log, total_mass=float(pi[0] + pi[10])).stated
    assert alone.ratio is None
    assert (both.ratio, both.half_width) == pytest.approx((total.ratio, total.half_width), rel=0.1)


def test_the_mass_that_remains_beside_a_pinned_link_is_determined(crane):
    model, pi, log = crane
    boom = float(pi[0] + pi[10] - model.standard_parameters()[0])  # beside the URDF's cart
    stated = checked(model, log, mass={"boom": boom}, pinned=["cart"]).stated
    assert stated.ratio == pytest.approx(1.0, abs=0.03)


def test_a_wide_range_is_a_bound_and_a_narrow_one_widens_the_interval(crane):
    model, pi, log = crane
    total = float(pi[0] + pi[10])
    assert checked(model, log, total_mass=[0.9 * total, 1.1 * total]).stated is None
    narrow = checked(model, log, total_mass=[0.98 * total, 1.02 * total]).stated
    exact = checked(model, log, total_mass=total).stated
    assert narrow.half_width == pytest.approx(exact.half_width + 0.02)
    cart, boom = float(pi[0]), float(pi[10])  # ranges of several masses count by their shares
    ranged, both = (
        checked(model, log, mass={"boom": [(1 - x) * boom, (1 + x) * boom],
                                  "cart": [(1 - y) * cart, (1 + y) * cart]}).stated
        for x, y in ((0.02, 0.04), (0.0, 0.0))
    )  # fmt: skip
    wider = (0.02 * boom + 0.04 * cart) / total
    assert ranged.half_width - both.half_width == pytest.approx(wider, rel=1e-6)


@pytest.mark.parametrize(
    ("ratio", "half_width", "verifies", "contradicts"),
    [
        (1.049, 0.049, True, False),
        (1.049, 0.051, False, False),
        (1.051, 0.049, False, False),
        (0.9, 0.049, False, True),
        (0.9, 0.051, False, False),
        (None, 0.0, False, False),
    ],
)
def test_each_limit_of_a_stated_mass(ratio, half_width, verifies, contradicts):
    stated = StatedMass(("total_mass",), ratio, half_width)
    assert (stated.verifies, stated.contradicts) == (verifies, contradicts)
    assert ("does not verify" in stated.message) is not (verifies or contradicts)


@pytest.mark.parametrize("mass", [0.0, -0.1])
def test_a_fit_without_a_total_mass_does_not_determine_it(mass):
    model = arm()
    standard = np.ones(len(model.layout.names))  # of other parameters than masses
    standard[: model.layout.n_inertial : 10] = mass
    assert not determines_total_mass(SimpleNamespace(model=model, standard=standard))
