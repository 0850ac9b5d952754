"""True robots are possible, as far from the URDF as was asked, and known by name."""

import re

import numpy as np
import pytest
from helpers.single_joint import one_joint
from scipy.linalg import eigvalsh

from robotid.base.exceptions import ModelError, SettingsError
from robotid.dynamics.simulation.simulation_settings import Truth
from robotid.dynamics.simulation.simulator import draw_parameters, perturbed_bodies
from robotid.robot.drives import LoadFriction
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling, pseudo_inertia


def distances(model, pi):
    """Return d^2 = 1/2 sum log^2 of the eigenvalues of J^-1 J', per body."""
    size = model.layout.n_inertial
    bodies = (pseudo_inertia(x[:size]) for x in (pi, model.standard_parameters()))
    pairs = zip(*bodies, strict=True)
    return np.array([0.5 * np.sum(np.log(eigvalsh(new, old)) ** 2) for new, old in pairs])


@pytest.mark.parametrize("size", [0.02, 0.1, 1.0])
def test_bodies_lie_as_far_in_the_metric_as_was_asked(panda, rng, size):
    draws = (perturbed_bodies(panda, size, rng) for _ in range(60))
    squares = np.concatenate([distances(panda, draw) for draw in draws])
    # ten independent squares of one standard deviation: mean 10, standard deviation sqrt(20)
    assert np.mean(squares) / size**2 == pytest.approx(10.0, abs=4 * np.sqrt(20 / len(squares)))
    assert np.std(squares) / size**2 == pytest.approx(np.sqrt(20), rel=0.25)


def test_drives_are_usual_for_the_size_of_their_weakest_joint(ur5, panda):
    for ratios in ((("panda_joint1", 1.0), ("panda_joint7", 2.0)),
                   (("panda_joint7", 2.0), ("panda_joint1", 1.0))):  # fmt: skip
        model = RobotModel.from_urdf(
            panda.tree.path, joints=panda.joints, couplings=(Coupling("motor", ratios),),
            own_terms={"panda_joint1": (LoadFriction(),)},
        )  # fmt: skip
        pi = draw_parameters(model, Truth(inertials=0.0), np.random.default_rng(3))
        drawn = dict(zip(model.layout.names, pi, strict=True))
        for d, term in model.layout.drive_parameters:
            drive = model.layout.drives[d].name  # joints 5 to 7 have 12 of the usual 50 N m
            is_weak = term.name != "load" and (drive == "motor" or drive[-1] in "567")
            low, high = (12.0 / 50.0 * x if is_weak else x for x in term.typical)
            assert low <= drawn[f"{drive}.{term.name}"] <= high, drive
    none = draw_parameters(ur5, Truth(drives="none", inertials=0.0), np.random.default_rng(3))
    np.testing.assert_array_equal(none, ur5.standard_parameters())


def test_the_same_seed_draws_the_same_and_stated_values_stand(ur5):
    first, second = (
        draw_parameters(ur5, truth, np.random.default_rng(5))
        for truth in (Truth(), Truth(values={"elbow_joint.viscous": 7.5, "forearm_link.m": 4.0}))
    )
    changed = [ur5.layout.names[i] for i in np.flatnonzero(first != second)]
    assert changed == ["forearm_link.m", "elbow_joint.viscous"]
    assert second[ur5.layout.names.index("elbow_joint.viscous")] == 7.5


ERRORS = {
    "truth: values: 'elbow_joint.viscos' is not a parameter of ur5. Did you mean "
    "'elbow_joint.viscous'?": {"elbow_joint.viscos": 1.0},
    "truth: body 'forearm_link': the smallest eigenvalue of its": {"forearm_link.m": 0.01},
    "truth: elbow_joint.viscous is -1 N m s/rad, expected 0 or more": {"elbow_joint.viscous": -1.0},
}


@pytest.mark.parametrize("message", ERRORS)
def test_values_that_cannot_be_are_refused(ur5, rng, message):
    with pytest.raises(SettingsError, match=re.escape(message)):
        draw_parameters(ur5, Truth(inertials=0.0, values=ERRORS[message]), rng)


def test_a_urdf_that_cannot_be_is_no_start(tmp_path, rng):
    model = one_joint(tmp_path, inertia=-0.1)
    with pytest.raises(
        ModelError,
        match=r"body 'body' of the URDF: the smallest eigenvalue .* is -0.05, expected 0",
    ):
        perturbed_bodies(model, 0.1, rng)
