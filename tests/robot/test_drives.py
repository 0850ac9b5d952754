"""Every term walks from the regressor to the written file, in the joints that have it."""

import itertools
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.driven import driven, driven_log, fitted_in
from helpers.paths import URDF
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError, NotConvergedError, SettingsError
from robotid.cli.identify import identify
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.dynamics import torque
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.friction_projection import drive_moments, project_friction
from robotid.dynamics.rows import COMPILED, TrajectoryRows
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulator import RobotPlant
from robotid.dynamics.torque import (
    InstantRegressor,
    drive_motion_along,
    joint_torque_regressor,
    predict,
    remember,
    trajectory_regressor,
)
from robotid.output.files.mjcf import write_mjcf
from robotid.output.files.urdf import load_identified, read_sidecar, write_urdf
from robotid.output.report.pictures import friction_chart
from robotid.robot.drive_term import DriveMotion, Family, MemorylessTerm, Shape
from robotid.robot.drives import (
    DRIVE_TERMS,
    FAMILIES,
    TERM_CLASSES,
    TERMS,
    Asymmetric,
    Bristles,
    Counterbalance,
    Cubic,
    Harmonic,
    Hat,
    Lag,
    LoadFriction,
    LuGre,
    PositionCoulomb,
    Power,
    Presliding,
    Ramp,
    Spring,
    Stribeck,
    Tanh,
    drive_line,
    has_turned,
    term_from_dict,
)
from robotid.robot.examples import example_urdf
from robotid.robot.mass_matrix import joint_mass_matrices
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)
JOINTS = ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint")
MOTOR = Coupling("motor", (("elbow_joint", 1.0), ("wrist_1_joint", -0.5)))
R = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, -0.5]])  # drives over joints
OWN = [
    Asymmetric(), LoadFriction(), Cubic(data_range=(0.0, 3.0)), Stribeck(speed=0.3),
    Tanh(speed=0.2), Power(exponent=0.4), Ramp(low=0.1, high=0.7),
    Harmonic(order=2.0, is_sine=True), PositionCoulomb(order=2, centre=0.3),
    Presliding(displacement=0.05),
    LuGre(displacement=0.05, speed=0.3, excess=0.6), Spring(data_range=(-1.0, 2.0)),
    Hat(at=0.4, before=-0.3, after=0.9), Counterbalance(arm=0.2, base=0.6, angle=0.4, rest=0.3),
    Lag(),
]  # fmt: skip
PAST = ("presliding", "lugre", "lag")  # which a single instant does not show


@pytest.fixture(params=[*TERMS.values(), *OWN], ids=lambda term: term.name)
def term(request):
    return request.param


@pytest.fixture
def model(term, ur5):
    couplings = (MOTOR,) if term.is_shared else ()
    drives = [*JOINTS, *(c.name for c in couplings)]
    is_common = term.name in TERMS
    model = RobotModel.from_urdf(
        ur5.tree, joints=JOINTS, terms=(term.name,) if is_common else (), couplings=couplings,
        own_terms={} if is_common else {drive: (term,) for drive in drives},
    )  # fmt: skip
    return model.with_reference(truth(model)) if term.has_state else model


def states(rng, samples=70):
    q = rng.uniform(-2, 2, (samples, 3))
    v, a, tau = rng.uniform(-2, 2, (3, samples, 3))
    t, segment = np.arange(samples) / 100, np.zeros(samples, dtype=int)
    return Trajectory(t=t, q=q, v=v, a=a, tau=tau, joints=JOINTS, rate=100.0, segment=segment)


def drive_part(model):
    return slice(model.layout.n_inertial, None)


def log_of(model, pi, rng):
    """Return a log of exact torques, those of what drives remember among them."""
    log = exact_log(model, pi, rng, samples=200)
    motion = remember(model, process(log, EXACT))
    return Log(t=log.t, q=log.q, v=log.v, a=log.a, joints=log.joints,
               tau=predict(model, [pi], motion)[0])  # fmt: skip


def test_only_what_physics_keeps_from_being_negative_is_bounded():
    bounded = {term.name for term in (*TERMS.values(), *OWN) if term.is_nonnegative}
    assert bounded == {
        "armature", "viscous", "coulomb", "load", "tanh", "rise1", "presliding", "lugre",
        "counterbalance",
    }  # fmt: skip


# What each term is, written down a second time: of w, dw/dt, sign w, angle and load.
EXPECTED = {
    "armature": lambda m: m.a, "viscous": lambda m: m.v, "coulomb": lambda m: np.sign(m.v),
    "offset": lambda m: 1.0,
    "asymmetric": lambda m: np.abs(m.v),
    "load": lambda m: np.sign(m.v) * np.abs(m.load),
    "cubic": lambda m: m.v**3,
    "stribeck": lambda m: np.sign(m.v) / np.exp(np.abs(m.v) / 0.3),
    "tanh": lambda m: (1 - np.exp(-2 * m.v / 0.2)) / (1 + np.exp(-2 * m.v / 0.2)),
    "power": lambda m: np.sign(m.v) * np.exp(0.4 * np.log(np.abs(m.v))),
    "rise1": lambda m: np.sign(m.v) * np.interp(np.abs(m.v), [0.1, 0.7], [0.0, 1.0]),
    "sin2": lambda m: 2 * np.sin(m.q) * np.cos(m.q),
    "coulomb_q2": lambda m: np.sign(m.v) * (m.q**2 - 0.6 * m.q + 0.09),
    "presliding": lambda m: np.sign(m.v),
    "lugre": lambda m: np.sign(m.v) * (1 + 0.6 * np.exp(-((m.v / 0.3) ** 2))),
    "spring": lambda m: np.minimum(np.maximum(m.q, -1.0), 2.0),
    "spring1": lambda m: np.maximum(
        0.0, np.minimum((m.q + 0.3) / 0.7, (0.9 - m.q) / 0.5)
    ),
    "lag": lambda m: 0.0,
}  # fmt: skip


def test_the_column_of_each_term_is_what_its_equation_says(model, term, rng):
    x = states(rng)
    Y = joint_torque_regressor(model, x.q, x.v, x.a).reshape(70, 3, -1)[:, :, drive_part(model)]
    ratios = R[: len(model.layout.drives)]
    load = np.zeros((70, 3))
    if term.has_state:
        bodies = model.with_terms({})
        Y_I = joint_torque_regressor(bodies, x.q, x.v, x.a)[:, : model.layout.n_inertial]
        load = (Y_I @ model.reference[: model.layout.n_inertial]).reshape(70, 3)
    share = ratios / (ratios**2).sum(axis=1, keepdims=True)
    m = DriveMotion(*(z @ ratios.T for z in (x.q, x.v, x.a, x.v)), load @ share.T, 0 * x.v)
    if term.name == "counterbalance":  # k (L - L_0) dL/dq by a difference of the spring's energy

        def energy(q):
            where = [0.2 * np.cos(q - 0.4) - 0.6, 0.2 * np.sin(q - 0.4)]
            return 0.5 * (np.hypot(*where) - 0.3) ** 2

        expected = (energy(m.q + 1e-6) - energy(m.q - 1e-6)) / 2e-6
    else:
        expected = EXPECTED[term.name](m)
    np.testing.assert_allclose(Y, (expected + 0 * m.v)[:, None, :] * ratios.T, atol=1e-9)


def test_compiled_instant_and_plain_rows_are_one(model, term, rng):
    x = remember(model, states(rng))
    W = trajectory_regressor(model, x).reshape(70, 3, -1)
    kept = np.arange(W.shape[2])
    if term.name not in PAST:
        at_once = InstantRegressor(model, kept)
        np.testing.assert_allclose(at_once(x.q[3], x.v[3], x.a[3]), W[3], atol=1e-12)
    for engine in (COMPILED, "Pinocchio"):
        rows = TrajectoryRows(model, x, 2 + np.cos(x.q), model.support, kept, engine)
        blocks = [[own.copy() for own in block] for block in rows.blocks(0, 70)]
        for j, parts in enumerate(zip(*blocks, strict=True)):
            expected = np.column_stack([W[:, j, rows.columns[j]], x.tau[:, j]])
            expected *= np.sqrt(rows.weights[:, [j]])
            np.testing.assert_allclose(np.vstack(parts), expected, atol=1e-12)


def test_the_plant_moves_as_the_regressor_says(model, rng):
    x, pi = states(rng, 40), truth(model)
    plant = RobotPlant(model, pi)
    u = (joint_torque_regressor(model, x.q, x.v, x.a) @ pi).reshape(40, 3)
    for k in np.flatnonzero((np.abs(x.v @ R.T) > 0.1).all(axis=1)):  # tanh is the sign there
        np.testing.assert_allclose(plant.acceleration(x.q[k], x.v[k], u[k]), x.a[k], atol=1e-8)
        D = joint_mass_matrices(model, pi, x.q[[k]])[0]
        np.testing.assert_allclose(plant.mass_matrix(x.q[k]), D, atol=1e-12)


def test_friction_that_holds_any_load_is_refused_by_the_plant():
    model = RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"), joints=JOINTS, terms=(),
        own_terms={"elbow_joint": [LoadFriction()]},
    )  # fmt: skip
    pi = truth(model)
    pi[-1] = 5.0
    with pytest.raises(NotConvergedError, match="load-dependent friction does not converge"):
        RobotPlant(model, pi).acceleration(np.ones(3), np.ones(3), 50 * np.ones(3))


def test_identification_recovers_it(model, term, rng):
    pi = truth(model)
    own = {"signals": EXACT, "estimator": "wls", "friction": "none", "doctor": False}
    found = identify(model, [log_of(model, pi, rng)], **own)
    np.testing.assert_allclose(found.base, found.mapping.to_base(pi), atol=1e-6)
    drives = drive_part(model)
    if not (term.is_inertia or term.name.startswith("sin")):  # those may come in a group
        np.testing.assert_allclose(found.standard[drives], pi[drives], atol=1e-6)


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
    x = states(rng)
    wanted, found = (predict(m, [pi], remember(m, x))[0] for m in (model, loaded))
    np.testing.assert_allclose(found, wanted, atol=1e-9)  # the load of the gears, too
    if term.dynamics:
        value = repr(float(written[f"elbow_joint.{term.name}"]))
        assert f'{term.dynamics}="{value}"' in (tmp_path / "arm.urdf").read_text()


def test_terms_of_one_drive_stand_side_by_side():
    own = {"elbow_joint": [LoadFriction(), Tanh(speed=0.2)], "motor": [Cubic()]}
    model = RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"), joints=JOINTS, couplings=(MOTOR,), own_terms=own
    )
    of_joints = [f"{joint}.{term}" for joint, term in itertools.product(JOINTS, DRIVE_TERMS)]
    at = of_joints.index("elbow_joint.offset") + 1
    shared = [f"motor.{name}" for name in DRIVE_TERMS if TERMS[name].is_shared]
    assert list(model.layout.drive_names) == [
        *of_joints[:at], "elbow_joint.load", "elbow_joint.tanh", *of_joints[at:], *shared,
        "motor.cubic",
    ]  # fmt: skip
    plain = model.with_terms({})
    assert list(plain.layout.drive_names) == of_joints + shared
    with pytest.raises(SettingsError, match="terms are given for wrist_9, expected drives"):
        model.with_terms({"wrist_9": [Cubic()]})


def test_a_guarded_term_stays_as_it_was_at_the_end_of_what_was_seen():
    v = np.array([-9.0, -1.0, 0.5, 2.0, 9.0])
    motion = DriveMotion(v, v, v, np.sign(v), v, v)
    wanted = [-(1.5**3), -1.0, 0.125, 1.5**3, 1.5**3]
    np.testing.assert_allclose(Cubic(data_range=(0.0, 1.5)).column(motion), wanted)
    hook = Stribeck(data_range=(0.8, 2.0), speed=0.5).column(motion)
    np.testing.assert_allclose(hook, np.exp(-2 * np.array([2, 1, 0.8, 2, 2])) * np.sign(v))
    wave = Harmonic(data_range=(-1.0, 2.0), order=3.0).column(motion)
    np.testing.assert_allclose(wave, np.cos(3 * np.array([-1.0, -1.0, 0.5, 2.0, 2.0])))


def reversing(rng, samples=4000):
    """Return a joint that goes to and fro, with the segment begun anew half way."""
    t = np.arange(samples) / 500
    q = 0.4 * np.sin(2 * t) + 0.1 * np.sin(7.3 * t + 0.4)
    v = 0.8 * np.cos(2 * t) + 0.73 * np.cos(7.3 * t + 0.4)
    begins = np.zeros(samples, dtype=bool)
    begins[[0, samples // 2]] = True
    return t, q, v, begins


@pytest.mark.parametrize("term", [Presliding(displacement=0.03),
                                  LuGre(displacement=0.03, speed=0.2, excess=0.5)])  # fmt: skip
def test_presliding_is_the_solution_of_its_differential_equation(term, rng):
    t, q, v, begins = reversing(rng)
    still = np.zeros_like(q)
    z = term.column(DriveMotion(q, v, still, np.sign(v), still, still, begins))

    def level(w):
        return 1 + 0.5 * np.exp(-((w / 0.2) ** 2)) if isinstance(term, LuGre) else 1.0

    state, h = np.empty_like(q), (t[1] - t[0]) / 50  # a finer Euler scheme
    for k in range(len(t)):
        if begins[k]:
            s = np.sign(v[k]) * level(v[k])
        else:
            for w in np.linspace(v[k - 1], v[k], 50):
                s += h * (w - np.abs(w) / level(w) * s) / 0.03
        state[k] = s
    assert np.abs(state).max() > 0.9
    np.testing.assert_allclose(z, state, atol=0.02)
    assert np.abs(z - np.sign(v)).max() > 1.5  # it takes a way to turn round


def test_a_late_torque_is_to_first_order_its_rate(rng):
    path = example_urdf("ur5_robot.urdf")
    model = RobotModel.from_urdf(path, joints=JOINTS, own_terms={j: [Lag()] for j in JOINTS})
    pi, late = truth(model), 0.004
    lags = [k for k, name in enumerate(model.layout.names) if name.endswith(".lag")]
    pi[lags] = late
    model = model.with_reference(pi)
    t = np.arange(600) / 200
    motion = random_fourier(model, rng)
    q, v, a = motion.evaluate(t)
    x = Trajectory(
        t=t, q=q, v=v, a=a, tau=0 * q, joints=JOINTS, rate=200.0,
        segment=np.zeros(600, dtype=int), direction=np.tanh(v @ R[:3].T / 0.3),
    )  # fmt: skip
    with_lag = predict(model, [pi], remember(model, x))[0]
    punctual = replace(x, memory=np.zeros((600, 3)))
    on_time = predict(model, [pi], punctual)[0]
    expected = np.column_stack([np.interp(t - late, t, column) for column in on_time.T])
    inner = slice(5, -5)
    scale = np.abs(with_lag - on_time)[inner].max(axis=0)
    assert (np.abs(with_lag - expected)[inner].max(axis=0) < 0.15 * scale).all()


def test_a_trajectory_without_its_memory_is_refused(rng):
    model = RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"), joints=JOINTS, own_terms={"elbow_joint": [LoadFriction()]}
    )
    x = states(rng)
    with pytest.raises(DataError, match=r"memory has shape \(70, 0\), expected \(70, 1\)"):
        predict(model, [truth(model)], x)
    load = drive_motion_along(model, x).load
    wanted = np.sign(x.v[:, 1]) * np.abs(load[1])
    np.testing.assert_allclose(remember(model, x).memory[:, 0], wanted, atol=1e-12)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"term": "Stribek"}, "term 'Stribek' is not one of .*Stribeck"),
        ({"term": "Stribeck", "sped": 1.0}, "Stribeck has no 'sped'; it has data_range, speed"),
        ({"term": "Stribeck", "speed": "x"}, "speed is 'x', expected 1e-09 to 1e.09"),
        ({"term": "Harmonic", "is_sine": 1}, "is_sine is 1, expected true or false"),
        ({"term": "Cubic", "data_range": [1.0]}, "data_range is .1.0,., expected .lowest,"),
    ],
)
def test_a_term_that_cannot_be_read_is_refused(table, message):
    with pytest.raises(SettingsError, match=message):
        term_from_dict(table)


@pytest.mark.parametrize("family", FAMILIES.values(), ids=lambda family: family.name)
def test_families_make_terms_of_the_range_seen(family):
    seen = {"v": (0.1, 2.0), "q": (-1.0, 2.0)}
    sizes = [np.sqrt(np.prod(shape.within(seen))) for shape in family.shapes]
    terms = family.make(seen, *sizes)
    assert len({term.name for term in terms}) == len(terms) >= 1
    for term in terms:
        assert term_from_dict(term.to_dict()) == term
        assert not term.guards or term.data_range in (seen[term.guards], (-np.inf, np.inf))
    for shape, size in zip(family.shapes, sizes, strict=True):
        assert {getattr(term, shape.name) for term in terms} == {size}


def test_a_hook_that_only_slow_motion_shows_is_a_base_parameter():
    own = {joint: [Stribeck(speed=0.02, data_range=(0.03, 0.4))] for joint in JOINTS}
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), joints=JOINTS, own_terms=own)
    assert {f"{joint}.stribeck" for joint in JOINTS} <= set(structural_mapping(model).base_names)


def test_what_drives_remember_is_of_the_model_not_of_what_was_remembered_before(rng, monkeypatch):
    monkeypatch.setattr(torque, "_START", 10**9)  # by rows, which check the memory
    path, own = example_urdf("ur5_robot.urdf"), {"elbow_joint": [LoadFriction(), Lag()]}
    model = RobotModel.from_urdf(path, joints=JOINTS, own_terms=own)
    x, other = states(rng), model.with_reference(truth(model))
    again = remember(other, remember(model, x))
    np.testing.assert_array_equal(again.memory, remember(other, x).memory)
    assert np.abs(again.memory - remember(model, x).memory).max() > 0.1


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LuGre(displacement=0.1, speed=0, excess=0.5), "LuGre: speed is 0, expected 1e-09"),
        (lambda: LuGre(displacement=0.1, excess=-1.0), "excess is -1.0, expected -0.99 to 1000"),
        (lambda: Presliding(displacement=0.0), "Presliding: displacement is 0.0, expected 1e-09"),
        (lambda: Stribeck(speed=-0.1), "Stribeck: speed is -0.1, expected 1e-09 to 1e"),
        (lambda: Tanh(speed=1e-320), "Tanh: speed is 1e-320, expected"),
        (lambda: Power(exponent=1e300), r"Power: exponent is 1e\+300, expected 0 to 10"),
        (lambda: Harmonic(order="x"), "Harmonic: order is 'x', expected -1e"),
        (lambda: PositionCoulomb(order=-1), "order is -1, expected 0 to 10"),
        (lambda: Ramp(low=0.5, high=0.5), "Ramp: low = 0.5, high = 0.5, expected increasing"),
        (lambda: Hat(before=0.0, at=0.5, after=0.2), "before = 0, at = 0.5, after = 0.2, expected"),
        (lambda: Counterbalance(arm=0.0), "Counterbalance: arm is 0.0, expected 1e-09"),
        (
            lambda: Cubic(data_range=(1.0, 0.0)),
            r"Cubic: data_range is \(1.0, 0.0\), expected \(lowest, highest",
        ),
        (lambda: Spring(data_range=(np.nan, 1.0)), "Spring: data_range is"),
    ],
)
def test_a_shape_that_divides_by_zero_is_refused(make, words):
    with pytest.raises(SettingsError, match=words):
        make()


def test_bounds_of_a_shape_are_shares_of_the_largest_speed_or_of_the_range_of_positions():
    seen = {"v": (0.1, 2.0), "q": (-1.0, 3.5)}
    speed, way, exponent = (
        FAMILIES[name].shapes[0] for name in ("stribeck", "presliding", "power")
    )
    assert speed.within(seen) == pytest.approx((0.005 * 2.0, 0.5 * 2.0))
    assert way.within(seen) == pytest.approx((0.0005 * 4.5, 0.015 * 4.5))
    assert exponent.within(seen) == (0.1, 0.9)


def test_knots_and_centres_of_families_lie_in_the_range_seen():
    seen = {"v": (0.1, 3.2), "q": (-1.0, 3.0)}
    rises = [(term.low, term.high) for term in FAMILIES["curve"].make(seen)]
    np.testing.assert_allclose(rises, [(0.0, 0.2), (0.2, 0.8), (0.8, 1.8), (1.8, 3.2)])
    table = {term.number: (term.before, term.at, term.after)
             for term in FAMILIES["spring_table"].make(seen)}  # fmt: skip
    wanted = {k: np.array([-1.5, -1.0, -0.5]) + 0.5 * (k - 1) for k in (1, 2, 3, 4, 6, 7, 8, 9)}
    assert list(table) == list(wanted)  # the middle one is the offset's
    np.testing.assert_allclose(list(table.values()), list(wanted.values()), atol=1e-12)
    by_position = FAMILIES["position"].make(seen)
    assert [(term.order, term.centre) for term in by_position] == [(1, 1.0), (2, 1.0)]


H = 1e-6


def test_the_slope_of_a_law_is_that_of_differences(term):
    law = getattr(term, "speed_law", None) or getattr(term, "position_law", None)
    if law is None:
        return
    shape = term.speed_shape or term.position_shape
    z = np.linspace(-1.93, 1.87, 77)
    (y, slope), (above, _), (below, _) = (law(x, *shape) for x in (z, z + H, z - H))
    is_smooth = np.abs(above - 2 * y + below) < 1e-9  # not at a kink
    assert np.mean(is_smooth) > 0.9
    exact = (above - below)[is_smooth] / (2 * H)
    np.testing.assert_allclose((slope + 0 * z)[is_smooth], exact, atol=1e-8)
    for one in (-1.3, 0.61):  # of single numbers, as it is compiled
        np.testing.assert_allclose(law(one, *shape)[0], law(np.array([one]), *shape)[0][0])


def test_friction_by_position_is_a_power_of_it():
    q = np.linspace(-1.0, 1.0, 9)
    for order in range(4):
        y, slope = PositionCoulomb.position_law(q, float(order), 0.3)
        np.testing.assert_allclose(y, (q - 0.3) ** order, atol=1e-15)
        np.testing.assert_allclose(slope, order * (q - 0.3) ** max(order - 1, 0))
    units = [PositionCoulomb(order=k).units for k in range(3)]
    assert units == [("N m", "N"), ("N m/rad", "N/m"), ("N m/rad^2", "N/m^2")]


def test_bristles_keep_what_the_solution_of_their_equation_keeps():
    s_0, w, c = 0.03, 0.4, 0.6
    v = np.array([0.0, 0.1, -0.3, 1.2, -2.0])
    way = np.array([0.0, 0.02, -0.05, 0.004, 0.1])
    g, slope, kept = Bristles.law((s_0, w, c), way, v)

    def level(v):
        return 1.0 + c * np.exp(-(v**2) / w**2)

    np.testing.assert_allclose(g, level(v))
    np.testing.assert_allclose(slope, (level(v + H) - level(v - H)) / (2 * H), atol=1e-8)
    for first in (-0.7, 1.4):  # dz/ds = 1 - z / g, by a fine Runge-Kutta scheme
        z, n = np.full(5, first), 400
        for _ in range(n):
            h = np.abs(way) / s_0 / n
            k1 = 1 - z / g
            k2 = 1 - (z + h / 2 * k1) / g
            z = z + h * (1 - (z + h / 2 * k2) / g)
        np.testing.assert_allclose(g + (first - g) * kept, z, atol=1e-5)


def test_a_family_is_advised_a_tenth_beyond_the_turns_that_it_needs():
    needs = {name: family.needs for name, family in FAMILIES.items() if family.needs}
    assert needs == {"harmonics1": 0.1, "harmonics2": 0.5, "harmonics4": 0.5}
    for name, turns in needs.items():
        enough = 1.1 * turns * 2 * np.pi  # [rad]
        assert has_turned(name, enough * (1 + 1e-9))
        assert not has_turned(name, enough * (1 - 1e-9))
    assert has_turned("spring", 0.0)


def test_the_line_of_a_drive_is_read_back_as_it_was():
    wave = Harmonic(data_range=(-1.0, 2.0), order=3.0, is_sine=True)
    [(joint, entries)] = tomllib.loads(drive_line("a joint", wave, "load", Spring())).items()
    assert joint == "a joint"
    assert entries[1] == "load"
    assert term_from_dict(entries[0]) == Harmonic(order=3.0, is_sine=True), "the range is the log's"
    assert term_from_dict(entries[2]) == Spring()


JOINT = "joint_1"
TRUE, SIZE, SPEED = f"{JOINT}.bend", 1.4, 0.25


@dataclass(frozen=True)
class Bend(MemorylessTerm):
    """Friction that sets in over a speed, tau = x atan(w / w_b)."""

    speed: float = 0.1

    label = "bend"
    guards = "v"
    usual = (0.3, 0.6)

    @staticmethod
    def speed_law(w, speed):
        z = w / speed
        return np.arctan(z), 1.0 / (speed * (1.0 + z * z))


@pytest.fixture
def bend(monkeypatch):
    """The term with its family in the catalogue, a robot that has it, and its parameters."""
    family = Family(
        "bend", "friction that bends", lambda own, speed: (Bend(data_range=own["v"], speed=speed),),
        (Shape("speed", ("rad/s", "m/s"), (0.01, 0.5), "v"),), is_automatic=True,
    )  # fmt: skip
    monkeypatch.setitem(TERM_CLASSES, "Bend", Bend)
    monkeypatch.setitem(FAMILIES, "bend", family)
    plain = RobotModel.from_urdf(URDF / "planar_2r.urdf")
    term = Bend(data_range=(0.0, 30.0), speed=SPEED)
    true, pi = driven(plain, {JOINT: (term,)}, {TRUE: SIZE})
    return SimpleNamespace(plain=plain, true=true, pi=pi, term=term)


def law(v):
    """Return the friction of the joint beside viscous and Coulomb's."""
    return SIZE * np.arctan(v / SPEED)


def test_a_new_term_is_identified_drawn_and_exported(bend, tmp_path):
    log = driven_log(bend.true, bend.pi, 3, duration=20.0, noise=0.001)
    found = fitted_in(bend.plain, [log], friction={JOINT: "bend", "*": "none"})
    (choice,) = found.drives
    ((shape,), (own,)) = choice.shapes, found.model.layout.own[JOINT]
    assert abs(shape.value - SPEED) < 3 * shape.std_error < 0.1 * SPEED
    assert term_from_dict(own.to_dict()) == own
    values = dict(zip(found.model.layout.names, found.standard, strict=True))
    assert values[TRUE] == pytest.approx(SIZE, rel=0.1)

    chart = friction_chart(found, JOINT)
    steady, v = chart.series[2].y, chart.x
    truth = dict(zip(bend.true.layout.names, bend.pi, strict=True))
    viscous, coulomb, offset = (truth[f"{JOINT}.{x}"] for x in ("viscous", "coulomb", "offset"))
    wanted = law(v) + viscous * v + coulomb * np.sign(v) + offset
    drawn = np.isfinite(steady)  # the line breaks where friction reverses
    np.testing.assert_allclose(steady[drawn], wanted[drawn], atol=0.05)
    assert drawn.sum() > 100

    rows = [(e.recording.trajectory, e.recording.mask) for e in found.fitted]
    moments = drive_moments(found.model, rows)
    simple = project_friction(found.model, found.standard, moments, ("viscous", "coulomb"))
    (drive,) = simple.drives
    assert drive.replaced == ("bend",)
    write_mjcf(simple.model, simple.pi, tmp_path / "robot.xml")
    (joint,) = (x for x in ET.parse(tmp_path / "robot.xml").iter("joint") if x.get("name") == JOINT)
    assert float(joint.get("damping")) == pytest.approx(drive.values["viscous"])
