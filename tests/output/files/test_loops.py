"""What result.json holds of loops, figure by figure, for two joints of two kinds and three logs."""

from types import SimpleNamespace

import numpy as np
import pytest

from robotid.output.files.entries import (
    _covariance,
    loop_entries,
    loop_parameters,
)


@pytest.fixture(scope="module")
def entries(crane):
    return loop_entries(crane)


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
