"""What result.json holds of loops, figure by figure, for two joints of two kinds and three logs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.crane import RATES, STARTS

from robotid.output.files.entries import (
    _covariance,
    input_entries,
    loop_entries,
    loop_parameters,
)


@pytest.fixture(scope="module")
def entries(crane):
    return loop_entries(crane)


def test_what_was_stated_has_no_error_and_what_was_found_has_its_own(crane, entries):
    estimate, loops = crane.fit.estimate, crane.fit.loops
    [k] = [k for k, name in enumerate(estimate.names) if name.endswith("delay")]
    units = {"kp": ("N/m", "N m/rad"), "kd": ("N s/m", "N m s/rad"), "delay": ("s", "s"),
             "limit": ("N", "N m"), "zero": ("m", "rad")}  # fmt: skip
    wanted = []
    for j, joint in enumerate(("rail", "turn")):
        for what, unit in units.items():
            if (joint, what) == ("turn", "limit"):
                continue  # it has none
            is_free = what == "delay"  # of all drives together
            wanted.append({
                "name": f"{joint}.{what}", "value": getattr(loops, what)[j],
                "std_error": estimate.std_error[k] if is_free else None,
                "quantile": estimate.quantile[k] if is_free else None,
                "unit": unit[j], "source": "data" if is_free else "stated",
            })  # fmt: skip
    assert entries["loop_parameters"] == wanted
    assert loops.delay == pytest.approx(np.full(2, 0.006), abs=4 * estimate.std_error[k])
    assert entries["simulation"]["controller"] == {
        "kind": "pd", "effort_limit": {"rail": 80.0}, "rate": None,
    }  # fmt: skip


def test_each_joint_has_the_error_of_its_own_unknown():
    names = [("a", "revolute"), ("b", "prismatic"), ("c", "revolute")]
    free_parameters = [("kp", (1,)), ("kp", (2,)), ("delay", (0, 2)), ("zero", (1,))]
    estimate = SimpleNamespace(
        std_error=np.array([1.0, 2.0, 3.0, 4.0]), quantile=np.array([2.1, 2.2, 2.3, 2.4]),
        details={"at_bound": ("delay",)},
    )  # fmt: skip
    values = {
        "kp": [10.0, 20.0, 30.0], "kd": [1.0, 2.0, 3.0], "delay": [0.1, 0.2, 0.3],
        "limit": [np.inf, 9.0, np.inf], "zero": [0.01, 0.02, 0.03],
    }  # fmt: skip
    fit = SimpleNamespace(
        loops=SimpleNamespace(**{what: np.array(x) for what, x in values.items()}),
        estimate=estimate,
        simulator=SimpleNamespace(
            free_parameters=[
                SimpleNamespace(name=what, what=what, joints=joints)
                for what, joints in free_parameters
            ]
        ),
    )
    joints = [SimpleNamespace(name=name, type=kind) for name, kind in names]
    loop = SimpleNamespace(kind="pd")
    found = SimpleNamespace(loop=loop, fit=fit, model=SimpleNamespace(limits=joints))
    shown = {entry["name"]: entry for entry in loop_parameters(found)}
    errors = {"b.kp": (1.0, 2.1), "c.kp": (2.0, 2.2), "a.delay": (3.0, 2.3), "c.delay": (3.0, 2.3),
              "b.zero": (4.0, 2.4)}  # fmt: skip
    assert len(shown) == 13
    for j, (joint, kind) in enumerate(names):
        force, way = ("N", "m") if kind == "prismatic" else ("N m", "rad")
        units = {"kp": f"{force}/{way}", "kd": f"{force} s/{way}", "delay": "s", "limit": force,
                 "zero": way}  # fmt: skip
        for what, unit in units.items():
            name = f"{joint}.{what}"
            if what == "limit" and joint != "b":
                assert name not in shown
                continue
            error, reach = errors.get(name, (None, None))
            source = "bound" if what == "delay" else "data"
            assert shown[name] == {
                "name": name, "value": values[what][j], "std_error": error, "quantile": reach,
                "unit": unit, "source": source if name in errors else "stated",
            }  # fmt: skip
    assert loop_parameters(SimpleNamespace(loop=SimpleNamespace(kind="torque"))) == []


def test_sums_of_bodies_that_were_not_fitted_are_named(crane):
    n, names = crane.model.layout.n_inertial, np.array(crane.mapping.base_names)
    is_body = np.array(crane.mapping.independent) < n
    assert is_body.sum() > 1
    assert (~is_body).sum() > 1
    error = np.ones(len(names))
    last, drive = np.flatnonzero(is_body)[-1], np.flatnonzero(~is_body)[0]
    error[[last, drive]] = np.inf
    other = loop_entries(replace(crane, base_error=error))
    assert other["ranges"]["undetermined"] == [names[last]]


def test_each_log_has_its_times_rate_and_role(crane):
    inputs = input_entries(crane)[1:]
    assert [entry["role"] for entry in inputs] == ["identification"] * 2 + ["validation"]
    for entry, start, rate in zip(inputs, STARTS, RATES, strict=True):
        rows = round(1.5 * rate)
        assert entry["samples"] == entry["rows_used"] == rows
        assert entry["rate"] == pytest.approx(rate)
        assert entry["start"] == start
        assert entry["end"] == pytest.approx(start + (rows - 1) / rate)


def test_open_loops_have_the_errors_of_each_joint_and_horizon(crane, entries):
    for role, runs in (("identification", crane.fitted), ("validation", crane.validation)):
        shown = [run.to_dict() for run in runs]
        if role == "identification":
            assert entries["simulation"][role] == shown
        assert len(shown) == {"identification": 2, "validation": 1}[role]
        for entry, run in zip(shown, runs, strict=True):
            assert (entry["start"], entry["end"]) == (run.log.t[0], run.log.t[-1])
            error = np.sqrt(np.mean((run.log.q - run.q) ** 2, axis=0))
            off = np.sqrt(np.mean((run.log.q_ref - run.log.q) ** 2, axis=0))
            for j, joint in enumerate(("rail", "turn")):
                own = entry["per_joint"][joint]
                assert own["unit"] == ("m", "rad")[j]
                assert own["rmse"] == pytest.approx(error[j])
                assert own["command_rmse"] == pytest.approx(off[j])
                assert own["urdf_rmse"] == run.baselines["urdf"][j]
            assert list(entry["horizons"]) == ["0.1", "0.5"]
            for horizon, errors in run.horizons.items():
                assert entry["horizons"][f"{horizon:g}"] == dict(
                    zip(("rail", "turn"), errors, strict=True)
                )
    [kept] = [run.to_dict() for run in crane.validation]
    share = 100 * crane.validation[0].rmse / crane.validation[0].log.q.std(axis=0)
    for joint, own in zip(("rail", "turn"), share, strict=True):
        assert kept["per_joint"][joint]["relative_error_pct"] == pytest.approx(own)


def test_the_fit_says_what_it_is(crane, entries):
    fit, estimate = entries["simulation"]["fit"], crane.fit.estimate
    assert fit["converged"] is True
    assert fit["parameters"] == len(estimate.names) == 5  # two armatures and frictions, one delay
    assert entries["structure"]["rank"] == estimate.rank == 5
    assert entries["uncertainty"]["inflation"] == estimate.details["inflation"]
    assert entries["simulation"]["signs"] == {"rail": 1.0, "turn": 1.0}


def test_the_covariance_is_that_of_the_free_parameters_that_are_not_at_a_bound(rng):
    """Free: a gain, the delay of both joints, an armature and a zero, which is at its bound."""
    slopes, A = rng.standard_normal((3, 4)), rng.standard_normal((4, 4))
    free = [("kp", (0,)), ("delay", (0, 1)), ("armature", (1,)), ("zero", (1,))]
    names = ["a.kp", "delay", "b.armature", "b.zero"]
    estimate = SimpleNamespace(
        theta=np.zeros(4), covariance=A @ A.T, details={"at_bound": ("b.zero",)}
    )
    simulator = SimpleNamespace(
        names=names, standard=lambda model, theta: (None, slopes),
        free_parameters=[SimpleNamespace(what=what, joints=joints) for what, joints in free],
    )  # fmt: skip
    model = SimpleNamespace(layout=SimpleNamespace(names=("x", "y", "z")), joints=("a", "b"))
    fit = SimpleNamespace(simulator=simulator)
    entry = _covariance(SimpleNamespace(fit=fit, estimate=estimate, model=model))
    assert entry["names"] == ["x", "y", "z", "a.kp", "a.delay", "b.delay", "b.zero"]
    S = np.vstack([slopes, np.eye(4)[[0, 1, 1, 3]]])[:, :3]
    L = np.array([[*row, *[0.0] * (7 - len(row))] for row in entry["root"]])
    np.testing.assert_allclose(L @ L.T, S @ (A @ A.T)[:3, :3] @ S.T, atol=1e-6)
