import re

import numpy as np
import pinocchio as pin
import pytest
from helpers.paths import URDF
from helpers.synthetic import truth

from robotid.base.exceptions import DataError, SettingsError
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import (
    Actuator,
    Controller,
    Noise,
    Payload,
    Sensors,
    Simulation,
    Steps,
)
from robotid.dynamics.simulation.simulator import (
    RobotPlant,
    Run,
    carried,
    follow,
    measure,
    simulate,
)
from robotid.robot.constraints import Contact
from robotid.robot.drives import Lag, LoadFriction, LuGre, Presliding
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling


def followed(model, pi, settings, *, seed=1, rate=500.0, duration=2.0):
    motion = random_fourier(model, np.random.default_rng(seed))
    return follow(model, pi, motion, rate=rate, duration=duration, settings=settings)


def test_computed_torque_with_the_right_bodies_follows_all_but_exactly(ur5):
    pi = ur5.standard_parameters()
    kinds = {}
    for kind in ("pd", "feedforward", "computed_torque", "perfect"):
        run = followed(ur5, pi, Simulation(controller=Controller(kind)), duration=1.0)
        kinds[kind] = np.abs(run.q - run.reference).max()
    assert kinds["computed_torque"] < 1e-4
    assert kinds["feedforward"] < 1e-4
    assert kinds["pd"] > 0.02  # it knows no gravity
    assert kinds["perfect"] == 0.0


def test_a_perfect_log_is_inverse_dynamics_drives_that_remember_included(ur5):
    own = {"elbow_joint": (LoadFriction(), Presliding(displacement=0.05))}
    model = ur5.with_terms(own)
    pi = truth(model)
    run, loop = (  # the second is a plant with states that is made to do the same
        followed(model, pi, Simulation(controller=controller), rate=1000.0, duration=1.5)
        for controller in (Controller("perfect"), Controller(bandwidth=100.0))
    )
    late = run.t > 0.3
    difference = (loop.tau - run.tau)[late][:, 2]
    assert np.sqrt(np.mean(difference**2)) < 0.02 * np.sqrt(np.mean(run.tau[:, 2] ** 2))


def test_drives_give_no_more_than_their_limits(ur5):
    pi, most = truth(ur5), {"shoulder_pan_joint": 8.0}
    free = followed(ur5, pi, Simulation())
    held = followed(ur5, pi, Simulation(actuator=Actuator(effort=0.4, limits=most)))
    assert free.tau[:, 0].min() < -9.0
    assert free.tau[:, 0].max() > 9.0
    assert (held.tau[:, 0].min(), held.tau[:, 0].max()) == (-8.0, 8.0)
    largest = 0.4 * np.array([j.effort for j in ur5.limits])
    assert (np.abs(held.tau) <= largest + 1e-9).all()
    assert np.abs(held.tau[:, 1]).max() == largest[1]
    assert held.saturated[0] == np.mean(np.abs(held.tau[:, 0]) == 8.0) > 0.0
    assert (free.saturated == 0.0).all()


def test_a_payload_is_taken_up_in_time(ur5):
    load = Payload("ee_link", 2.0, com=(0.1, 0.0, 0.05), inertia=(0.01, 0, 0.01, 0, 0, 0.01),
                   start=0.3)  # fmt: skip
    pi = truth(ur5)
    for kind in ("perfect", "feedforward"):
        run, empty = (
            followed(ur5, pi, Simulation(controller=Controller(kind), payload=p), duration=0.4)
            for p in (load, Payload())
        )
        first = int(np.argmax(np.abs(run.tau - empty.tau).max(axis=1) > 1e-9))
        assert run.t[first] == 0.3


def test_what_no_payload_can_be_is_refused(ur5):
    flat = Payload("ee_link", 1.0, inertia=(1.0, 0.0, 0.1, 0.0, 0.0, 0.1))
    words = r"payload: inertia is \[1.0, 0.0, .* physically inconsistent"
    with pytest.raises(SettingsError, match=words):
        carried(ur5, truth(ur5), flat)
    with pytest.raises(SettingsError, match="link 'base_link' is fixed to the world"):
        carried(ur5, truth(ur5), Payload("base_link", 1.0))


def test_a_torque_that_lags_is_late_in_the_log_of_its_joint(ur5, rng):
    model = ur5.with_terms({"elbow_joint": (Lag(),)})
    pi = truth(model)
    pi[model.layout.names.index("elbow_joint.lag")] = 0.01
    motion = random_fourier(model, np.random.default_rng(1))
    log = simulate(model, pi, motion, rate=500.0, duration=1.0, rng=rng)
    run = followed(model, pi, Simulation(), duration=1.0)
    np.testing.assert_allclose(log.tau[5:, 2], run.tau[:-5, 2], atol=1e-9)
    np.testing.assert_array_equal(log.tau[:, 3], run.tau[:, 3])


def test_an_elastic_gear_needs_a_rotor_and_stiffness_for_every_joint(ur5):
    soft = Actuator(stiffness={"elbow_joint": 1e4})
    for actuator, words in (
        (soft, "stiffness is not given for 'shoulder_pan_joint'. Set it for every joint"),
        (Actuator(stiffness=1e4), "has no armature, which an elastic gear needs"),
    ):
        with pytest.raises(SettingsError, match=words):
            followed(ur5, ur5.standard_parameters(), Simulation(actuator=actuator))
    with pytest.raises(SettingsError, match=r"backlash applies only to elastic gears. Set their"):
        Actuator(backlash=0.01)
    with pytest.raises(SettingsError, match="perfect, which has no limits and no elastic gears"):
        Simulation(controller=Controller("perfect"), actuator=Actuator(effort=1.0))
    with pytest.raises(SettingsError, match="kp and kd apply to kind pd or feedforward"):
        Controller("computed_torque", kp=3.0)


def test_gains_rates_and_durations_beyond_reason_are_told(ur5):
    wild = Simulation(controller=Controller("pd", kp=1e7, kd=1e6))
    with pytest.raises(DataError, match=r"the simulation diverged at t = .* lower gains"):
        followed(ur5, truth(ur5), wild)
    for rate, duration, steps in ((1e5, 3600.0, "1"), (1e-3, 5e3, r"\d{6,}")):
        words = rf"has .* samples of {steps} steps each, expected at most 2e\+07 steps in total and"
        with pytest.raises(SettingsError, match=words):
            followed(ur5, truth(ur5), Simulation(), rate=rate, duration=duration)


FOOT = {"constraints": [Contact("FL_FOOT")]}


@pytest.mark.parametrize(
    ("options", "words"), [({"free_flyer": True}, "base floats"), (FOOT, "has contacts")]
)
@pytest.mark.parametrize("kind", ["perfect", "pd"])
def test_only_robots_with_a_fixed_base_are_simulated(options, words, kind):
    model = RobotModel.from_urdf(example_urdf("solo12.urdf"), **options)
    with pytest.raises(DataError, match=f"{words}.*; simulation needs a robot with a fixed base"):
        followed(model, model.standard_parameters(), Simulation(controller=Controller(kind)))


def test_a_payload_adds_what_pinocchio_says_of_its_body(ur5):
    turned = pin.rpy.rpyToMatrix(0.3, -0.7, 1.1)
    I = turned @ np.diag([0.03, 0.05, 0.06]) @ turned.T  # noqa: E741
    xx, xy, xz, yy, yz, zz = I[np.triu_indices(3)]
    load = Payload("forearm_link", 1.7, com=(0.1, -0.2, 0.05), inertia=(xx, xy, yy, xz, yz, zz))
    pi = np.arange(float(len(ur5.layout.names)))
    added = carried(ur5, pi, load) - pi
    body = ur5.layout.bodies.index("forearm_link")
    own = pin.Inertia(1.7, np.array(load.com), I).toDynamicParameters()
    np.testing.assert_allclose(added[10 * body : 10 * body + 10], own, atol=1e-12)
    assert np.count_nonzero(added) == 10
    np.testing.assert_array_equal(pi, np.arange(float(len(pi))))  # as it was
    assert carried(ur5, pi, Payload("forearm_link", 0.0)) is pi


JOINTS = ("a", "b")
N = 4000


@pytest.fixture
def run():
    t = 3.0 + np.arange(N) / 500.0
    w = np.array([2.0, 3.0])
    q, v = np.sin(np.outer(t, w)), w * np.cos(np.outer(t, w))
    return Run(t, q, v, -(w**2) * q, np.array([10.0, 1.0]) * v, q, np.zeros(2))


def of(run, **stated):
    return measure(run, Sensors(**stated), JOINTS, np.random.default_rng(0))


def test_without_faults_the_log_is_the_motion(run):
    log = of(run, acceleration=True)
    for name in ("t", "q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(log, name), getattr(run, name))
    assert of(run, velocity=False).v is None
    assert of(run).a is None


def test_noise_has_its_standard_deviation_by_joint(run):
    log = of(run, noise=Noise(q=1e-3, v={"b": 0.1}, tau=0.05, torque={"a": 0.3}))
    np.testing.assert_allclose((log.q - run.q).std(axis=0), 1e-3, rtol=0.05)
    np.testing.assert_allclose((log.v - run.v).std(axis=0), [0.0, 0.1], rtol=0.05)
    share = 0.05 * np.sqrt(np.mean(run.tau**2, axis=0))
    level = (log.tau - run.tau).std(axis=0)
    np.testing.assert_allclose(level, np.hypot(share, [0.3, 0.0]), rtol=0.05)


def test_readings_are_rounded_to_steps_noise_included(run):
    log = of(run, step=Steps(q=0.01, v={"a": 0.1}, tau=0.5), noise=Noise(q=0.02))
    np.testing.assert_allclose(log.q / 0.01, np.round(log.q / 0.01), atol=1e-9)
    np.testing.assert_array_equal(log.v[:, 1], run.v[:, 1])
    assert np.abs(log.v[:, 0] - run.v[:, 0]).max() == pytest.approx(0.05, rel=0.05)
    np.testing.assert_allclose(log.tau, np.round(run.tau / 0.5) * 0.5)


def test_what_is_late_shows_what_was(run):
    log = of(run, torque_delay=0.01, velocity_delay=0.004)
    np.testing.assert_allclose(log.tau[5:], run.tau[:-5], atol=1e-9)
    np.testing.assert_allclose(log.v[2:], run.v[:-2], atol=1e-9)
    np.testing.assert_array_equal(log.q, run.q)
    drive = measure(run, Sensors(), JOINTS, np.random.default_rng(0), delay=np.array([0.0, 0.02]))
    np.testing.assert_allclose(drive.tau[10:, 1], run.tau[:-10, 1], atol=1e-9)
    np.testing.assert_array_equal(drive.tau[:, 0], run.tau[:, 0])


def test_time_stamps_err_and_still_increase(run):
    log = of(run, jitter=2e-4)
    assert (log.t - run.t).std() == pytest.approx(2e-4, rel=0.05)
    np.testing.assert_array_equal(log.q, run.q)  # what they err about
    rough = of(run, jitter=0.01)  # five sample times
    assert np.diff(rough.t).min() > 0.0


def test_samples_are_lost_at_random(run):
    log = of(run, dropped=0.2)
    assert len(log.t) == pytest.approx(0.8 * N, abs=4 * np.sqrt(0.16 * N))
    kept = np.searchsorted(run.t, log.t)
    np.testing.assert_array_equal(log.tau, run.tau[kept])
    two = Run(*(x[:3] for x in (run.t, run.q, run.v, run.a, run.tau, run.q)), np.zeros(2))
    with pytest.raises(DataError, match=r"of 3 samples remain, expected at least 2. Set a smaller"):
        of(two, dropped=0.999)


def test_settings_that_cannot_be_are_named(run):
    with pytest.raises(SettingsError, match=re.escape(
        "sensors: noise.q is given for 'c', which is not a moving joint: a, b"
    )):  # fmt: skip
        of(run, noise=Noise(q={"c": 1.0}))
    with pytest.raises(SettingsError, match=r"sensors.noise: q is -1.0, expected 0 to 1e12"):
        Noise(q=-1.0)
    with pytest.raises(SettingsError, match=r"sensors: dropped is 1.0, expected 0 to less than 1"):
        Sensors(dropped=1.0)


@pytest.fixture(scope="module")
def sticky():
    """A planar arm with a motor of both joints; friction of its own in two drives."""
    own = {
        "joint_2": (LuGre(displacement=0.05, speed=0.3, excess=0.6), LoadFriction()),
        "motor": (Presliding(displacement=0.02),),
    }
    coupling = Coupling("motor", (("joint_1", 1.0), ("joint_2", -0.5)))
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf", couplings=(coupling,), own_terms=own)
    pi = model.standard_parameters()
    values = {
        "joint_1.viscous": 0.7, "joint_1.coulomb": 1.2, "joint_2.offset": 0.4, "joint_2.lugre": 2.0,
        "joint_2.load": 0.1, "motor.coulomb": 0.3, "motor.presliding": 0.8, "motor.armature": 0.2,
        "joint_1.armature": 0.1, "joint_2.armature": 0.05,
    }  # fmt: skip
    for name, value in values.items():
        pi[model.layout.names.index(name)] = value
    return RobotPlant(model, pi)


def test_presliding_is_taken_up_over_its_way_and_level(sticky):
    for v in ([0.4, -0.1], [-0.2, 0.5]):
        w = np.array([v[1], v[0] - 0.5 * v[1]])  # of joint 2 and of the motor
        level = np.array([1 + 0.6 * np.exp(-((w[0] / 0.3) ** 2)), 1.0])
        rate, end = sticky.bristle_rate(np.array(v))
        np.testing.assert_allclose(rate, np.abs(w) / ([0.05, 0.02] * level))
        np.testing.assert_allclose(end, np.sign(w) * level)


def test_friction_and_its_chord_are_those_of_the_terms(sticky, rng):
    R = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -0.5]])
    q, v, load, z = rng.uniform(0.3, 1.0, (4, 2))
    w = R @ v
    g = 1 + 0.6 * np.exp(-((w[1] / 0.3) ** 2))
    share = abs(load[1])  # joint 2 bears its own load alone
    for state, lugre, presliding in ((None, 2.0 * g * np.sign(w[1]), 0.8 * np.sign(w[2])),
                                     (z, 2.0 * z[0], 0.8 * z[1])):  # fmt: skip
        F = sticky.friction(q, v, state)
        drives = [0.7 * w[0] + 1.2 * np.sign(w[0]), 0.4 + lugre + 0.1 * share * np.sign(w[1]),
                  0.3 * np.sign(w[2]) + presliding]  # fmt: skip
        np.testing.assert_allclose(sticky.friction_torque(F, v, load), R.T @ drives, atol=1e-9)
    along = np.array([1.2, 0.1 * share, 0.3])  # by bristles in no direction
    over = (R.T * (along / np.abs(w))) @ R
    np.testing.assert_allclose(sticky.chord(F, v, load), over, rtol=1e-6)
    np.testing.assert_allclose(sticky.armature, R.T @ np.diag([0.1, 0.05, 0.2]) @ R)


def test_a_motor_of_two_joints_bears_the_load_that_its_gear_leaves_it(rng):
    coupling = Coupling("motor", (("joint_1", 2.0), ("joint_2", -0.5)))
    own = {"motor": (LoadFriction(),)}
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf", couplings=(coupling,), own_terms=own)
    pi = model.standard_parameters()
    for name, value in {"motor.load": 0.15, "motor.coulomb": 0.4, "motor.armature": 0.03}.items():
        pi[model.layout.names.index(name)] = value
    plant, R = RobotPlant(model, pi), np.array([2.0, -0.5])
    q, v, u = rng.uniform(0.3, 1.0, (3, 2))
    v[1] = -v[1]
    a = plant.acceleration(q, v, u)
    load = plant.bodies_torque(q, v, a)
    borne = abs(R @ load) / 4.25  # the least torque w with R w nearest to the load
    friction = R * (0.4 + 0.15 * borne) * np.sign(R @ v)
    np.testing.assert_allclose(plant.friction_torque(plant.friction(q, v), v, load), friction)
    np.testing.assert_allclose(load + 0.03 * R * (R @ a) + friction, u, rtol=1e-9)
