"""Every term of the registry, and one made here, walks from the regressor to the written file."""

import itertools
import re

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.commands.job import job_from_settings
from robotid.export.urdf import load_identified, read_sidecar, write_urdf
from robotid.identification.pipeline import identify
from robotid.logs.data import Trajectory
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process
from robotid.regressor import prediction
from robotid.regressor.prediction import predict
from robotid.regressor.rows import COMPILED, TrajectoryRows
from robotid.regressor.torque import InstantRegressor, joint_torque_regressor
from robotid.report.tables import tables
from robotid.robot.drives import DRIVE_TERMS, TERMS, DriveTerm, friction_models
from robotid.robot.examples import example_urdf
from robotid.robot.mass_matrix import joint_mass_matrices
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling
from robotid.robot.prior import prior_spread
from robotid.simulation.closed_loop import simulate
from robotid.simulation.motions import random_fourier
from robotid.simulation.plant import RobotPlant

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)
JOINTS = ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint")
MOTOR = Coupling("motor", (("elbow_joint", 1.0), ("wrist_1_joint", -0.5)))
R = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, -0.5]])  # drives over joints


def cubed(motion):
    return motion.v**3


CUBIC = DriveTerm(
    "cubic", cubed, ("N m s^3/rad^3", "N s^3/m^3"), is_friction=True, is_default=False,
    usual=(0.2, 0.9),
)  # fmt: skip


@pytest.fixture(params=[*TERMS, CUBIC.name])
def term(request, monkeypatch):
    monkeypatch.setitem(TERMS, CUBIC.name, CUBIC)
    return TERMS[request.param]


@pytest.fixture
def model(term):
    couplings = (MOTOR,) if term.is_shared else ()
    path = example_urdf("ur5_robot.urdf")
    return RobotModel.from_urdf(path, joints=JOINTS, terms=(term.name,), couplings=couplings)


def states(rng, samples=70):
    q = rng.uniform(-2, 2, (samples, 3))
    v, a, tau = rng.uniform(-2, 2, (3, samples, 3))
    t, segment = np.arange(samples) / 100, np.zeros(samples, dtype=int)
    return Trajectory(t=t, q=q, v=v, a=a, tau=tau, joints=JOINTS, rate=100.0, segment=segment)


def drive_part(model):
    return slice(model.layout.n_inertial, None)


def test_a_new_term_is_cubed_speed_in_every_joint_that_its_drive_turns_with(monkeypatch, rng):
    monkeypatch.setitem(TERMS, CUBIC.name, CUBIC)
    path = example_urdf("ur5_robot.urdf")
    model = RobotModel.from_urdf(path, joints=JOINTS, terms=("cubic",), couplings=(MOTOR,))
    x = states(rng)
    Y = joint_torque_regressor(model, x.q, x.v, x.a).reshape(70, 3, -1)[:, :, drive_part(model)]
    expected = (x.v @ R.T)[:, None, :] ** 3 * R.T
    np.testing.assert_allclose(Y, expected, atol=1e-14)
    assert model.layout.drive_names[1:] == ("elbow_joint.cubic", "wrist_1_joint.cubic",
                                            "motor.cubic")  # fmt: skip
    assert model.layout.units[-1] == "N m s^3/rad^3"
    assert "cubic" not in DRIVE_TERMS
    assert friction_models()["viscous+coulomb+cubic"] == ("viscous", "coulomb", "cubic")
    settings = {"urdf": str(path), "model": {"friction": "viscous+coulomb+cubic"}}
    job = job_from_settings(settings, "job.toml", path.parent)
    assert set(job.terms) == {*DRIVE_TERMS, "cubic"}
    assert job.to_dict()["model"]["friction"] == "viscous+coulomb+cubic"


def test_compiled_instant_and_plain_rows_are_one(model, rng):
    x = states(rng)
    W = joint_torque_regressor(model, x.q, x.v, x.a).reshape(70, 3, -1)
    kept = np.arange(W.shape[2])
    at_once = InstantRegressor(model, kept)
    np.testing.assert_allclose(at_once(x.q[3], x.v[3], x.a[3]), W[3], atol=1e-12)
    for engine in (COMPILED, "Pinocchio"):
        rows = TrajectoryRows(model, x, 2 + np.cos(x.q), model.support(), kept, engine)
        blocks = [[own.copy() for own in block] for block in rows.blocks(0, 70)]
        for j, parts in enumerate(zip(*blocks, strict=True)):
            expected = np.column_stack([W[:, j, rows.columns[j]], x.tau[:, j]])
            expected *= np.sqrt(rows.weights[:, [j]])
            np.testing.assert_allclose(np.vstack(parts), expected, atol=1e-12)


def test_prediction_by_inverse_dynamics_is_that_by_rows(model, rng, monkeypatch):
    x, pi = states(rng), truth(model)
    expected = (joint_torque_regressor(model, x.q, x.v, x.a) @ pi).reshape(70, 3)
    for start in (0, 10**9):  # by inverse dynamics, by rows
        monkeypatch.setattr(prediction, "_START", start)
        np.testing.assert_allclose(predict(model, [pi], x)[0], expected, atol=1e-10)


def test_the_plant_moves_as_the_regressor_says(model, rng):
    x, pi = states(rng, 40), truth(model)
    plant = RobotPlant(model, pi)
    u = (joint_torque_regressor(model, x.q, x.v, x.a) @ pi).reshape(40, 3)
    for k in np.flatnonzero((np.abs(x.v @ R.T) > 0.1).all(axis=1)):  # tanh is the sign there
        np.testing.assert_allclose(plant.acceleration(x.q[k], x.v[k], u[k]), x.a[k], atol=1e-9)
        D = joint_mass_matrices(model, pi, x.q[[k]])[0]
        np.testing.assert_allclose(plant.mass_matrix(x.q[k]), D, atol=1e-12)


def test_a_simulated_robot_is_identified(model, rng):
    pi = truth(model)
    log = simulate(model, pi, random_fourier(model, rng), rate=500.0, duration=6.0, rng=rng)
    found = identify(model, [log], signals=SignalSettings(cutoff=20.0), estimator="wls")
    beta = found.mapping.to_base(pi)
    assert np.linalg.norm(found.base - beta) < 0.02 * np.linalg.norm(beta)


def test_identification_recovers_it_and_the_table_shows_it(model, term, rng):
    pi = truth(model)
    found = identify(model, [exact_log(model, pi, rng)], signals=EXACT, estimator="wls")
    np.testing.assert_allclose(found.base, found.mapping.to_base(pi), atol=1e-7)
    drives = drive_part(model)
    if not term.is_inertia:  # that of a joint may come in a group with inertia of its body
        np.testing.assert_allclose(found.standard[drives], pi[drives], atol=1e-7)
    html = tables(found)["drives"].replace("<wbr>", "")
    lines = [re.sub(r"<[^>]*>", " ", row) for row in html.split("</tr>")[1:]]
    for name, value in zip(model.layout.drive_names, found.standard[drives], strict=True):
        (line,) = [line for line in lines if f" {name} " in line]
        assert float(line.split()[1]) == pytest.approx(value, rel=1e-2)
        assert term.units[0] in line


def test_its_prior_spread_would_alone_explain_the_torque(model, term, rng):
    motion = process(exact_log(model, truth(model), rng), EXACT)
    spread = prior_spread(model, motion.squares, len(motion.t))[drive_part(model)]
    assert (spread > 0).all()
    for j, s in enumerate(spread[:3]):
        tau, v, a = (np.sqrt(np.mean(x[:, j] ** 2)) for x in (motion.tau, motion.v, motion.a))
        alone = tau / term.column(type("Typical", (), {"v": v, "a": a, "direction": 1.0}))
        assert s >= alone * (1 - 1e-12) if term.is_inertia else s == pytest.approx(alone)


def test_it_is_written_and_read_back(model, term, rng, tmp_path):
    pi = truth(model)
    sidecar = write_urdf(model, pi, tmp_path / "arm.urdf", dynamics=True)
    facts = read_sidecar(sidecar)
    written = dict(zip(model.layout.drive_names, pi[drive_part(model)], strict=True))
    for joint in JOINTS:
        assert facts["drives"][joint] == {term.name: written[f"{joint}.{term.name}"]}
    loaded, read_back = load_identified(tmp_path / "arm.urdf", sidecar)
    assert loaded.layout == model.layout
    np.testing.assert_array_equal(read_back[drive_part(model)], pi[drive_part(model)])
    if term.dynamics:
        value = repr(float(written[f"elbow_joint.{term.name}"]))
        assert f'{term.dynamics}="{value}"' in (tmp_path / "arm.urdf").read_text()


def test_the_layout_knows_its_sign_size_and_preference(model, term):
    layout, drives = model.layout, drive_part(model)
    assert set(layout.is_nonnegative()[drives]) == {term.is_nonnegative}
    assert set(layout.preference()[drives]) == {term.preference}
    assert set(layout.scales(0.5)[drives]) == {0.25 if term.is_inertia else 1.0}
    assert [name.split(".")[0] for name in layout.drive_names] == [
        *JOINTS, *(["motor"] if term.is_shared else []),
    ]  # fmt: skip
    assert {found for _, found in layout.drive_parameters} == {term}
    np.testing.assert_array_equal(layout.drive_loads, R[: len(layout.drives)].T)


def test_terms_of_one_drive_stand_side_by_side():
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), joints=JOINTS, couplings=(MOTOR,))
    own = [f"{joint}.{term}" for joint, term in itertools.product(JOINTS, DRIVE_TERMS)]
    shared = [f"motor.{name}" for name in DRIVE_TERMS if TERMS[name].is_shared]
    assert list(model.layout.drive_names) == own + shared
