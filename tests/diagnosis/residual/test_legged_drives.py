"""Drive terms of a robot on its feet, whose contact forces are eliminated from the rows."""

import numpy as np
import pytest
from helpers.stands import recorded, stand

from robotid.base.exceptions import SettingsError
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.drive_choice import choose_drives
from robotid.diagnosis.residual.term_trials import Trials, take_sample
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.constraint_rows import without_forces
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fit import solve_recordings
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.robot.constraints import Contact
from robotid.robot.drives import Lag, LoadFriction, Stribeck
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
PLANTED = {"FL_HFE": 0.1, "HR_KFE": 0.1}  # excess of Stribeck friction [N m]


def quadruped(**options):
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=("viscous", "coulomb"),
        constraints=[Contact(foot) for foot in FEET], **options,
    )  # fmt: skip


def solved(planted):
    """Return the fit, with viscous and Coulomb friction, of a robot with Stribeck friction."""
    rng, model = np.random.default_rng(2), quadruped()
    own = {joint: [Stribeck(speed=0.1)] for joint in planted}
    plant = quadruped(own_terms=own)
    pi = plant.standard_parameters()
    size = {"viscous": 0.02, "coulomb": 0.05}
    for i, name in enumerate(plant.layout.names):
        joint, _, term = name.partition(".")
        pi[i] += size.get(term, planted.get(joint, 0.0) if term == "stribeck" else 0.0)
    motion = stand(model, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, parts=6, length=2.0)
    log = recorded(plant, pi, motion, rng, rate=100.0, duration=12.0)
    signals = SignalSettings(cutoff=None, velocity="measured", acceleration="measured")
    recordings = Recordings(model, structural_mapping(model), [hold_log(model, log, signals)])
    return solve_recordings(recordings, EstimatorSettings("wls"), is_last=False).solution


@pytest.fixture(scope="module")
def fit():
    return solved(PLANTED)


def wanted(fit, *joints, families=None):
    return {joint: families if joint in joints else () for joint in fit.model.joints}


def test_planted_terms_are_selected_and_no_others(fit):
    neighbours = ("FL_KFE", "HR_HFE")
    choices = choose_drives(fit, wanted(fit, *PLANTED, *neighbours))
    assert {x.joint: x.families for x in choices} == {
        **{joint: ("stribeck",) for joint in PLANTED}, **{joint: () for joint in neighbours}
    }  # fmt: skip
    for choice in choices:
        for shape in choice.shapes:
            assert shape.value == pytest.approx(0.1, abs=3 * shape.std_error)
            assert shape.std_error < 0.02


def test_the_row_of_a_joint_alone_has_all_of_its_projected_torque(fit, rng):
    """Row j over sqrt(P_jj) has the same products with the regressor as all rows together."""
    sample = take_sample(fit, for_drives=True)
    z, j = rng.standard_normal((len(sample.r), 2)), 4
    Z = np.zeros((*sample.r.shape, 2))
    Z[:, 6 + j] = z
    used = sample.weight > 0
    is_whole = used.all(axis=1)
    Z *= is_whole[:, None, None]
    z *= is_whole[:, None]
    every = Trials(sample, without_forces(sample.basis, Z), 0.0).whole
    alone = Trials(sample.of_joint(j), z[:, None], 0.0).whole
    np.testing.assert_allclose(alone.T[:, :2], every.T[:, :2], atol=1e-9 * np.abs(every.T).max())
    np.testing.assert_allclose(alone.S[:2], every.S[:2], rtol=1e-6, atol=1e-9 * every.S.max())
    assert is_whole.mean() > 0.3


def test_columns_of_other_joints_are_refitted_with_the_projected_rows(fit, rng):
    sample = take_sample(fit, for_drives=True)
    Z = rng.standard_normal((*sample.r.shape, 2))
    together = sample.with_columns(Z)
    size = sample.W.shape[2]
    added, left = together.W[..., size:], sample.weight[..., None] * without_forces(sample.basis, Z)
    ratio = added[sample.weight > 0] / left[sample.weight > 0]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[0], ratio.shape))
    fewer = together.with_some_columns(np.append(np.arange(size), size + 1))
    np.testing.assert_array_equal(fewer.W, np.delete(together.W, size, axis=2))
    wanted = sample.with_columns(Z[..., 1:]).normal
    np.testing.assert_allclose(fewer.normal.A, wanted.A, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(fewer.normal.B, wanted.B, rtol=1e-9, atol=1e-6)


def test_families_that_need_the_load_are_refused(fit):
    with pytest.raises(SettingsError, match="FL_HFE has load, which needs the joint load torque"):
        choose_drives(fit, wanted(fit, "FL_HFE", families=("load",)))
    for term in (LoadFriction(), Lag()):
        with pytest.raises(SettingsError, match=f"FL_HFE has the drive term '{term.name}', which"):
            quadruped(own_terms={"FL_HFE": [term]})
