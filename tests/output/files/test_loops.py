"""What result.json holds of loops, figure by figure, for two joints of two kinds and three logs."""

from types import SimpleNamespace

import numpy as np

from robotid.output.files.entries import _covariance, loop_entries, loop_parameters


def test_each_joint_has_its_gains_with_units_and_sources(crane):
    shown = {entry["name"]: entry for entry in loop_parameters(crane)}
    units = {"rail": ("N/m", "N s/m", "m"), "turn": ("N m/rad", "N m s/rad", "rad")}
    loops, unknowns = crane.fit.loops, crane.fit.simulator.free_parameters
    free = {(x.what, crane.model.joints[j]): k for k, x in enumerate(unknowns) for j in x.joints}
    for j, (joint, (of_kp, of_kd, of_zero)) in enumerate(units.items()):
        for what, unit in (("kp", of_kp), ("kd", of_kd), ("delay", "s"), ("zero", of_zero)):
            entry, k = shown[f"{joint}.{what}"], free.get((what, joint))
            assert (entry["value"], entry["unit"]) == (getattr(loops, what)[j], unit)
            assert (entry["source"] == "stated") == (k is None)
            error = None if k is None else crane.fit.estimate.std_error[k]
            assert entry["std_error"] == error


def test_bodies_that_no_log_determines_are_named_as_undetermined(crane):
    undetermined = loop_entries(crane)["ranges"]["undetermined"]  # boom.Izz is fitted
    assert undetermined == ["boom.mcx", "boom.mcy", *crane.undetermined]


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
