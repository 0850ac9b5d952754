"""The first fit of a loop, from which the others go on."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.base.exceptions import DataError, NotConvergedError
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop import stages as fit
from robotid.identification.closed_loop.loop_settings import LoopSettings


class DataRange(Exception):
    """What was fitted first, and how."""


@dataclass
class Simulator:
    free_parameters: tuple
    windows: tuple
    prior: np.ndarray


@dataclass
class Estimator:
    rounds: int

    def minimise(self, simulator):
        raise DataRange(simulator, self.rounds)


@pytest.mark.parametrize("kind", ["pd", "torque"])
def test_the_first_fit_is_of_drives_alone_with_the_bodies_of_the_urdf(monkeypatch, kind):
    free_parameters = tuple(
        SimpleNamespace(name=name, what=what)
        for name, what in (("m", "body"), ("kp", "kp"), ("mcx", "body"), ("coulomb", "term"))
    )
    simulator = Simulator(free_parameters, ("first", "second", "third"), np.zeros(4))
    initialised = SimpleNamespace(simulator=simulator, estimator=Estimator(rounds=9), vary=None)
    named = {"pd": "_initialise_from_commands", "torque": "_initialise_from_torque"}
    monkeypatch.setattr(fit, named[kind], lambda *_: initialised)
    monkeypatch.setattr(fit, "_check_settings", lambda *_: None)
    monkeypatch.setattr(fit, "_few", lambda windows: windows[::2])
    with pytest.raises(DataRange) as caught:
        fit.fit_loops(None, [], LoopSettings(kind=kind), None)
    first, rounds = caught.value.args
    assert [unknown.name for unknown in first.free_parameters] == ["kp", "coulomb"]
    assert (first.windows, rounds) == (("first", "third"), 1)


@dataclass
class Started(Simulator):
    starts: int = 0
    error: str = ""
    names: tuple = ()
    lag = exact = torque = None

    def with_better_start(self, theta):
        return replace(self, starts=self.starts + 1)


@dataclass
class Recorder:
    rounds: int
    fits: list
    inflation: float = 3.0

    def minimise(self, simulator, theta=None):
        self.fits.append(("steps", self.rounds, len(simulator.windows), simulator.starts))
        return simulator.prior

    def joint_step(self, simulator, theta):
        return theta

    def fit(self, simulator, theta, exact):
        self.fits.append(("fit", self.rounds, len(simulator.windows), simulator.starts))
        return SimpleNamespace(theta=theta)


def test_only_the_last_fit_is_to_all_windows_from_better_starts(monkeypatch):
    simulator, fits = Started((), tuple(range(96)), np.zeros(0)), []
    others = dict.fromkeys(("linear", "encoders", "plain", "torque", "vary", "limited"))
    initialised = SimpleNamespace(simulator=simulator, estimator=Recorder(9, fits), **others)
    monkeypatch.setattr(fit, "_initialise_from_commands", lambda *_: initialised)
    monkeypatch.setattr(fit, "_check_settings", lambda *_: None)
    monkeypatch.setattr(fit, "refine_steps", lambda simulator, _, estimate: (simulator, estimate))
    monkeypatch.setattr(fit, "is_stated", lambda *_: np.array([False]))
    found = fit.fit_loops(None, [], LoopSettings(), SimulationSettings(), chooses=False)
    few = fits[0][2]
    assert few < 48
    assert fits == [
        ("steps", 1, few, 0),
        ("steps", 1, 48, 1),
        ("steps", 1, 48, 2),
        ("fit", 9, 96, 4),
    ]
    assert len(found.simulator.windows) == 96


@pytest.mark.parametrize(
    ("chosen", "passes", "last"),
    [
        (["a", "b"], [["a", "b", "c"], ["b", "c"]], ["a 1 yes", "b 2 yes", "c 2 no"]),
        (["b", ""], [["a", "b", "c"], ["a", "c"]], ["b 1 yes", "a 2 no", "c 2 no"]),
        (["", ""], [["a", "b", "c"]] * 2, ["a 2 no", "b 2 no", "c 2 no"]),
    ],
)
def test_terms_that_are_not_chosen_are_tried_a_second_time(monkeypatch, chosen, passes, last):
    """And the loops are fitted with those of each pass; after the first one in any case."""
    fits, tried = [], []
    simulator = Started((), tuple(range(3)), np.zeros(0))
    others = dict.fromkeys(("linear", "encoders", "plain", "vary", "limited"))
    initialised = SimpleNamespace(
        simulator=simulator, estimator=Recorder(9, fits), torque="torque", **others
    )

    def choose(simulator, theta, offered, estimator):
        tried.append([set_[0].name for set_ in offered])
        assert estimator.inflation == 1.0
        assert simulator.names[-len(offered) :] == tuple(tried[-1])
        own = chosen[len(tried) - 1]
        return [
            SimpleNamespace(name=name, number=len(tried), is_chosen=name == own)
            for name in tried[-1]
        ]

    def extended(simulator, theta, sets):
        names = simulator.names + tuple(set_[0].name for set_ in sets)
        return replace(simulator, names=names), theta

    every = [(SimpleNamespace(name=name), None) for name in "abc"]
    monkeypatch.setattr(fit, "_initialise_from_commands", lambda *_: initialised)
    monkeypatch.setattr(fit, "_check_settings", lambda *_: None)
    monkeypatch.setattr(fit, "candidates", lambda simulator, torque: every * (torque == "torque"))
    monkeypatch.setattr(fit, "choose", choose)
    monkeypatch.setattr(fit, "_with", extended)
    monkeypatch.setattr(fit, "impossible", lambda *_: {})
    monkeypatch.setattr(fit, "refine_steps", lambda simulator, _, estimate: (simulator, estimate))
    monkeypatch.setattr(fit, "is_stated", lambda *_: np.array([False]))
    stages = []
    found = fit.fit_loops(
        None,
        [],
        LoopSettings(),
        SimulationSettings(),
        progress=lambda *call: stages.append(call[0]),
    )
    assert tried == passes
    assert stages[:2] == ["trying friction terms", "fitting loops"]
    assert [f"{t.name} {t.number} {'yes' if t.is_chosen else 'no'}" for t in found.tried] == last
    assert found.simulator.names == tuple(name for name in chosen if name)
    assert [kind for kind, *_ in fits].count("fit") == max(1, len(found.simulator.names))


def test_where_a_settling_step_cannot_be_simulated_the_parameters_are_fitted():
    class Unsteady:
        def settle(self, simulator, estimate):
            raise NotConvergedError("no solution", "step 1")

        def fit(self, simulator, theta):
            return "fitted", simulator, theta

    simulator = SimpleNamespace(exact=None, with_better_start=lambda theta: ("from", theta))
    found = fit._settled(simulator, Unsteady(), SimpleNamespace(theta="first"))
    assert found == (("from", "first"), ("fitted", ("from", "first"), "first"))


def test_where_the_states_after_a_settling_step_cannot_be_simulated_the_parameters_are_fitted():
    """The step can be simulated with the small steps of the fit, its derivatives cannot."""

    def better(theta):
        if theta[0] > 1.0:
            raise NotConvergedError("no solution", "step 1")
        return started(theta)

    def started(theta):
        return SimpleNamespace(exact=None, with_better_start=better, start=theta[0])

    class TooLong:
        def settle(self, simulator, estimate):
            found = {"std_error": np.array([0.1]), "sigma": np.ones(1)}
            return SimpleNamespace(theta=estimate.theta + 2.0, **found)

        def fit(self, simulator, theta):
            return simulator.start, theta

    first = np.array([0.5])
    simulator, found = fit._settled(started([7.0]), TooLong(), SimpleNamespace(theta=first))
    assert simulator.start == 0.5
    assert found == (0.5, first)


def test_speeds_of_saturated_drives_are_the_largest_of_all_logs(monkeypatch):
    speeds = {"one": {"a": 2.0, "b": 1.0}, "two": {"b": 3.0}, "three": {"a": 1.5}}
    monkeypatch.setattr(fit, "largest_speeds", speeds.get)
    model = SimpleNamespace(joints=("a", "b", "c"))
    found = fit._largest_speeds(model, LoopSettings(), list(speeds))
    np.testing.assert_array_equal(found, [2.0, 3.0, 0.0])
    stated = LoopSettings(limit={"b": 5.0})
    np.testing.assert_array_equal(fit._largest_speeds(model, stated, list(speeds)), [2.0, 0.0, 0.0])


def test_logs_that_command_no_joint_to_move_are_refused():
    q_ref = np.array([[0.1, 0.2], [0.1, 0.2], [0.1, 0.3]])
    log = SimpleNamespace(name="b.csv", q_ref=q_ref, v_ref=None, tau_ref=None)
    still = SimpleNamespace(name="a.csv", q_ref=q_ref[:2], v_ref=None, tau_ref=0 * q_ref[:2])
    settings = SimulationSettings()
    with pytest.raises(DataError, match=r"^a\.csv: the commands of all joints are constant, want"):
        fit._check_settings(None, [still, still], LoopSettings(), settings)
    fit._check_settings(None, [still, log], LoopSettings(), settings)
    pushed = SimpleNamespace(name="c.csv", q_ref=q_ref[:2], v_ref=None, tau_ref=q_ref[1:])
    fit._check_settings(None, [pushed], LoopSettings(), settings)
    fit._check_settings(None, [still], LoopSettings(kind="torque"), settings)


@dataclass(frozen=True)
class Stepping:
    """A simulator of which only the step counts."""

    windows: tuple
    robot: SimpleNamespace
    fine: SimpleNamespace | None = None


def test_the_change_by_halving_the_steps_is_part_of_the_covariance(monkeypatch):
    """Rows of 8 ms and steps of at most 3 ms: 8 / 3 ms, then half of it; 16 times finer at most."""
    t = 5.0 + 0.008 * np.arange(4)
    window = SimpleNamespace(log=SimpleNamespace(t=t))
    simulator = Stepping((window,), SimpleNamespace(model="arm", step=3e-3))
    error, tried = np.array([0.5, 0.01]), []

    def moved(now, half, theta):
        tried.append((now.fine and now.fine.step, half.fine.step, half.fine.corrects))
        return (np.array([-0.03, 1.9e-3]) if len(tried) == 2 else np.array([0.4, -0.05])), error

    @dataclass(frozen=True)
    class Found:
        theta: np.ndarray
        covariance: np.ndarray
        details: dict

    monkeypatch.setattr(
        fit, "ClosedLoopRobot",
        lambda model, step, corrects: SimpleNamespace(model=model, step=step, corrects=corrects),
    )  # fmt: skip
    monkeypatch.setattr(fit, "_settled", lambda now, estimator, estimate: (now, estimate))
    C = np.array([[0.25, 1e-3], [1e-3, 1e-4]])
    start = Found(np.array([1.0, 2.0]), C, {"inflation": 2.0})
    now, found = fit.refine_steps(simulator, SimpleNamespace(moved=moved), start)
    step = 0.008 / 3
    assert [x[1] for x in tried] == pytest.approx([step / 2, step / 4])
    assert all(x[2] for x in tried)
    assert now.fine.step == pytest.approx(step / 2)
    change = np.array([-0.03, 1.9e-3])
    np.testing.assert_allclose(found.covariance, C + np.outer(change, change))
    assert found.details == {
        "inflation": 2.0, "step": pytest.approx(step / 2), "halving": pytest.approx(0.19)
    }  # fmt: skip
