import numpy as np
import pytest
from helpers.mujoco_plant import plant, torque_log

from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows, open_loops
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.from_commands import driven_log, identify_loops
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.position_errors import run_open_loop
from robotid.identification.closed_loop.stages import torque_rows
from robotid.robot.model import RobotModel

SIGNALS = SignalSettings(cutoff=30.0)
DRIVEN = LoopSettings(kind="torque")


@pytest.fixture(scope="module")
def arm():
    """A planar arm in MuJoCo, a log to fit and one kept apart: positions and torques."""
    rng = np.random.default_rng(5)
    robot = plant("planar", rng, delay=0.0)
    logs = [torque_log(robot, rng, duration=d, noise=2e-5, torque=0.05) for d in (6.0, 3.0)]
    return robot, *logs


def found_by(arm, **settings):
    robot, log, kept = arm
    chosen = SimulationSettings(bodies=0.0, step=4e-3, **settings)
    return identify_loops(
        robot.model, [log], [kept], DRIVEN, chosen, signals=SIGNALS, chooses=False
    )


@pytest.fixture(scope="module")
def alone(arm):
    return found_by(arm, torques=False)


@pytest.fixture(scope="module")
def both(arm):
    return found_by(arm)


def test_what_is_fed_forward_is_the_mean_torque_between_two_rows():
    t = np.arange(5) * 0.01
    tau = np.column_stack([t, t**2])
    model = RobotModel.from_urdf(plant("planar", np.random.default_rng(0)).model.tree)
    log = Log(t, np.zeros((5, 2)), tau, model.joints, v=np.ones((5, 2)))
    heard = driven_log(model, log, SignalSettings())
    np.testing.assert_allclose(heard.tau_ref[:4, 0], t[:4] + 0.005)
    np.testing.assert_allclose(heard.tau_ref[:4, 1], (t[:4] ** 2 + t[1:] ** 2) / 2)
    np.testing.assert_allclose(heard.tau_ref[4], tau[4])
    assert heard.v_ref is None
    late = driven_log(model, log, SignalSettings(torque_delay=0.01))
    np.testing.assert_allclose(late.tau_ref[:3], heard.tau_ref[1:4])
    np.testing.assert_array_equal(late.tau, log.tau)  # rows of torque are moved back elsewhere


def test_the_true_robot_does_under_its_torque_what_mujocos_does(arm):
    robot, rng = arm[0], np.random.default_rng(8)
    log = driven_log(robot.model, torque_log(robot, rng, duration=2.0, rate=500.0), SIGNALS)
    loops = open_loops(robot.model, robot.parameters)
    run = run_open_loop(ClosedLoopRobot(robot.model, step=1e-3), loops, log)
    # its friction is soft over 1e-2 rad/s, ours over 1e-4
    assert (run.rmse < 3e-3).all()
    assert (run.rmse < 0.05 * run.spread).all()
    steady = []  # each half second from the measured state
    for w in cut_windows(log, 0.5, 0.0):
        q, v = w.start
        moved = log.q[w.counted] - q - np.outer(log.t[w.counted] - log.t[w.start_row], v)
        steady.append(moved)
    error = np.sqrt(np.mean(np.concatenate(steady) ** 2, axis=0))
    np.testing.assert_allclose(run.baselines["steady"], error)


def assert_drives_are_found(robot, estimate, share):
    for name, value in zip(estimate.names, estimate.theta, strict=True):
        joint, _, kind = name.rpartition(".")
        size = robot.truth[f"{joint}.coulomb" if kind == "offset" else name]
        assert abs(value - robot.truth[name]) < share * size, name


def test_roll_outs_alone_find_the_drives_of_an_arm(arm, alone):
    estimate = alone.fit.estimate
    assert estimate.converged
    kinds = {name.rpartition(".")[2] for name in estimate.names}
    assert kinds == {"armature", "viscous", "coulomb", "offset"}, "no gain, no delay"
    assert alone.fit.simulator.torque is None
    assert_drives_are_found(arm[0], estimate, 0.04)
    urdf = arm[0].model.standard_parameters()[:20]
    np.testing.assert_array_equal(alone.standard[:20], urdf)  # bodies stay: bodies=0


def test_rows_of_torque_and_roll_outs_weigh_in_one_estimate(arm, alone, both):
    simulator, estimate = both.fit.simulator, both.fit.estimate
    assert estimate.converged
    assert_drives_are_found(arm[0], estimate, 0.04)
    A, _ = simulator.rows(estimate.theta)
    # each row counts by half, for what it drives counts, too
    whole = torque_rows(both.fit.linear)
    np.testing.assert_allclose(np.sqrt(2.0) * simulator.torque.R, whole.R, atol=1e-9)
    # one noise is in both: they tell no more than the better of them, by itself
    rows = np.linalg.inv(2.0 * A.T @ A + np.diag(1.0 / simulator.prior_std**2))
    best = np.minimum(np.sqrt(np.diag(rows)), alone.fit.estimate.std_error)
    assert (estimate.std_error > 0.5 * best).all()
