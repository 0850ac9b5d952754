"""Which findings a result has."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats

from robotid.base.findings import Finding
from robotid.diagnosis.verdict import fit_findings as findings
from robotid.diagnosis.verdict.fit_findings import (
    _bound_findings,
    _correlated,
    _dense_bodies,
    _drive_findings,
    _grown,
    _impossible_shapes,
    _outlier_findings,
    _static_findings,
    _total_mass,
    consistency_findings,
    locked_findings,
)
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.robust import Outlier
from robotid.robot.bodies import density_share
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia


@pytest.mark.parametrize(
    ("file", "joints", "where"),
    [
        ("solo12.urdf", ["FL_HAA", "FL_HFE"], "FL_KFE"),  # not the other legs
        ("solo12.urdf", ["FL_KFE"], "FL_HAA, FL_HFE"),
        # neither the wheels nor the torso, which only lifts
        ("tiago_no_hand.urdf", [f"arm_{i}_joint" for i in range(2, 8)], "arm_1_joint"),
    ],
)
def test_locked_joints_are_named_where_they_carry_or_are_carried(file, joints, where):
    model = RobotModel.from_urdf(example_urdf(file), joints=joints)
    (finding,) = locked_findings(model, [])
    assert (finding.code, finding.where) == ("locked_at_zero", where)
    assert locked_findings(model, where.split(", ")) == []


def test_all_joints_of_a_floating_base_matter():
    model = RobotModel.from_urdf(
        example_urdf("solo12.urdf"), joints=["FL_HAA", "FL_HFE"], free_flyer=True
    )
    (finding,) = locked_findings(model, [])
    assert finding.where.split(", ") == list(model.locked)
    assert len(model.locked) == 10


def solved(**details):
    """What a fit of a possible robot says of its solvers."""
    check = SimpleNamespace(is_positive=True)
    estimate = SimpleNamespace(details=details)
    return SimpleNamespace(mass_matrix=check, estimate=estimate, estimator=EstimatorSettings())


def test_the_share_of_poses_with_a_mass_matrix_that_is_none_is_said():
    fit = solved()
    fit.mass_matrix = SimpleNamespace(
        is_positive=False, positive_share=0.935, poses=400, smallest_eigenvalue=-0.0125
    )
    (finding,) = consistency_findings(fit)
    assert finding.code == "mass_matrix"
    assert "not positive definite at 6.5 % of 400 random poses" in finding.message
    assert "(smallest eigenvalue -0.0125)" in finding.message


def test_five_outliers_are_named_and_the_others_counted():
    def said(count, is_robust):
        outliers = [
            Outlier("run.csv", f"j{k}", 1.25 * k, 10.0 + k, -2.0 * k, 40.4 - k, 3)
            for k in range(count)
        ]
        fit = SimpleNamespace(outliers=outliers, estimator=SimpleNamespace(is_robust=is_robust))
        (finding,) = _outlier_findings(fit)
        assert (finding.severity, finding.where) == ("warning", "j0")
        assert finding.evidence == {"places": count, "largest": 40.4}
        return finding.message

    few, many = said(5, False), said(7, True)
    assert few.startswith("5 outliers in the fitted logs: j0 at 0.000 s of run.csv")
    assert few.endswith("j4 at 5.000 s of run.csv: measured 14, predicted -8, residual 36 times "
                        "the typical one; check the recording there, cut it out, or set robust = "
                        "'tukey' in [estimator]")  # fmt: skip
    assert said(1, False).startswith("1 outlier in the fitted logs: j0 at 0.000 s")
    assert "j5" not in many
    assert many.endswith(
        "residual 36 times the typical one; and 2 more; the robust loss downweighted them"
    )


def test_the_parameter_that_terms_make_least_sure_is_named_from_tenfold_on():
    def choice(joint, *names, **grown):
        return SimpleNamespace(joint=joint, families=names, grown=grown)

    drives = (
        choice("a", "lugre", "load", coulomb=12.0, viscous=41.6, offset=3.0),
        choice("b", "cubic", coulomb=9.9, viscous=2.0),
        choice("c", "cubic", coulomb=50.0),  # of which it is said already
        choice("d"),
        choice("e", "load", offset=10.1),
    )
    first, last = _grown(SimpleNamespace(drives=drives), {"c"})
    assert (first.where, first.evidence) == ("a", {"grown": 41.6})
    assert first.message.startswith(
        "a: lugre, load multiplies the standard error of viscous by 42;"
    )
    assert (last.where, last.evidence) == ("e", {"grown": 10.1})


def test_correlated_terms_of_a_drive_are_said_by_their_worst_pair_and_sum():
    names = ("one.m", "a.viscous", "a.coulomb", "b.viscous", "b.coulomb", "b.offset", "c.offset")
    R = np.eye(7)
    for i, k, r in ((1, 2, -0.97), (3, 4, 0.955), (4, 5, -0.98), (0, 6, 0.99), (2, 6, 0.99)):
        R[i, k] = R[k, i] = r
    size = np.array([1.0, 0.5, 0.25, 2.0, 0.125, 3.0, 1.0])
    drives = (0, 0, 1, 1, 1, 2)
    layout = SimpleNamespace(
        names=names, n_inertial=1, prismatic={"b"}, drives=("a", "b", "c"),
        drive_parameters=[(d, None) for d in drives],
    )  # fmt: skip
    v = np.array([-2.0, -1.0, -0.5, 0.5, 1.0, 3.0])
    curves = {
        joint: SimpleNamespace(v=v, torque=10 * v + k, std=0.1 * np.arange(1, 7))
        for k, joint in enumerate("ab")
    }
    found = SimpleNamespace(
        model=SimpleNamespace(layout=layout), standard_covariance=R * np.outer(size, size),
        at_bound=np.zeros(7, dtype=bool), standard=np.arange(7) + 0.25, standard_error=size,
        friction=curves.__getitem__, drives=(),
    )  # fmt: skip
    a, b = _correlated(found)
    assert (a.code, a.severity, a.where, a.evidence) == (
        "correlated_terms", "note", "a", {"r": pytest.approx(-0.97)}
    )  # fmt: skip
    assert a.message == (
        "a: viscous 1.25 +- 0.5, coulomb 2.25 +- 0.25 are strongly correlated (r = -0.970): use "
        "their sum; friction and offset are 5 +- 0.4 at 0.5 and 30 +- 0.6 at 3 rad/s"
    )
    assert b.message == (
        "b: coulomb 4.25 +- 0.12, offset 5.25 +- 3 are strongly correlated (r = -0.980): use their "
        "sum; friction and offset are 6 +- 0.4 at 0.5 and 31 +- 0.6 at 3 m/s"
    )


def test_bounds_that_bind_are_a_warning_where_data_or_masses_contradict_a_stated_one():
    def said(*active, ours=(1.04, 2.08), masses=(0.11, 3.9)):
        fit = solved(active=active)
        wls = (1.0, 2.0)
        fit.metrics = lambda name: SimpleNamespace(
            per_joint={
                joint: SimpleNamespace(rmse=x)
                for joint, x in zip("ab", wls if name == "wls" else ours, strict=True)
            }
        )
        prior, standard = np.full((2, 22), 7.0)
        prior[[0, 10]], standard[[0, 10]] = (2.0, 4.0), masses
        layout = SimpleNamespace(n_inertial=20, bodies=("one", "two"))
        fit.model = SimpleNamespace(layout=layout, standard_parameters=lambda: prior)
        fit.standard = standard
        bounds = SimpleNamespace(mass={"one": [0.1, 2.0]}, com={"two": []})
        fit.estimator = SimpleNamespace(bounds=bounds)
        found = consistency_findings(fit)
        assert all(f.code == "active_bound" for f in found)
        return [(f.severity, f.where, f.message) for f in found]

    fine = "the URDF's values are outside them; the bounds do not increase the torque error"
    assert said("mass one") == [("note", "mass one", f"the bounds mass one are active: {fine}")]
    ((severity, where, message),) = said("mass one", "cone two", "mass two", ours=(1.06, 2.11))
    assert (severity, where) == ("warning", "mass one, mass two")
    assert message.startswith(
        "the bounds mass one, mass two are active: they increase the torque error of a, b; check"
    )
    ((severity, _, message),) = said("total_mass all", ours=(1.0, 2.11))
    assert severity == "warning"
    assert "they increase the torque error of b; check" in message
    # next to nothing is left of a link
    ((severity, _, message),) = said("centre_of_mass two", masses=(0.09, 0.21))
    assert severity == "warning"
    assert "with them one has 0.09 of its 2 kg; check" in message
    # a bound of the geometry is no one's statement
    ((severity, _, message),) = said("mass two", masses=(0.09, 0.19))
    assert severity == "note"
    assert "with them one has 0.09 of its 2 kg, two has 0.19 of its 4 kg; check" in message
    assert said("cone one", "inertia two") == []


def test_drives_whose_friction_has_no_direction_where_all_of_their_joints_count_are_named():
    yes, no = True, False
    first = [[yes, no], [no, yes], [yes, yes]], [[0, 0, 1], [1, 1, 1], [0, 0, 0]]
    second = [[yes, yes], [no, no]], [[0, 0, 0], [1, 1, 1]]
    third = [[yes, no]], None

    def said(*logs):
        layout = SimpleNamespace(
            drives=[SimpleNamespace(name=name) for name in ("a", "b", "pair")],
            drive_ratios=np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -2.0]]),
        )
        recordings = [
            SimpleNamespace(
                mask=np.array(mask),
                trajectory=SimpleNamespace(direction=None if sign is None else np.array(sign)),
                extent=SimpleNamespace(samples=100 * k, smooth=7 * k),
            )
            for k, (mask, sign) in enumerate(logs, start=1)
        ]
        fitted = [SimpleNamespace(recording=r) for r in recordings]
        model = SimpleNamespace(is_static=True, layout=layout)
        (finding,) = _static_findings(SimpleNamespace(model=model, fitted=fitted))
        return finding

    found = said(first, second)
    assert found.evidence == {"rows": 300.0, "samples": 21.0}
    assert "the 300 rows count as 21 independent samples" in found.message
    assert "the Coulomb friction of a, pair: at rest" in found.message
    assert "the Coulomb friction of a, b, pair: at rest" in said(second).message
    assert "Coulomb" not in said(first, third).message


def test_the_share_of_a_validation_log_beyond_what_friction_was_fitted_to_is_said(rng):
    """Slower than the fit has seen is not beyond it; rows that are not used do not count."""
    v, q = np.full((120, 2), 9.0), np.full((120, 2), 9.0)
    v[:, 1], q[:, 1] = np.resize([0.05, 0.5, -0.5], 120), 0.1
    v[:5, 1], v[5:8, 1], q[10:13, 1], q[20, 1] = 1.2, -1.2, -0.6, 0.9
    mask = np.zeros((120, 2), dtype=bool)
    mask[:100, 1] = True
    v[100:, 1] = q[100:, 1] = 5.0
    term = SimpleNamespace(guards="v", data_range=(0.1, 1.0))
    other = SimpleNamespace(guards="q", data_range=(-0.5, 0.8))
    loose = SimpleNamespace(guards="q", data_range=(-np.inf, np.inf))
    shape = SimpleNamespace(name="stribeck.speed", value=0.0123, unit="rad/s", is_at_bound=True)

    def said(*terms):
        choice = SimpleNamespace(
            joint="b", shapes=[shape, SimpleNamespace(is_at_bound=False)], terms=terms,
            data_range={"v": (0.1, 1.0), "q": (-0.5, 0.8)}, families=("stribeck", "position"),
        )  # fmt: skip
        motion = SimpleNamespace(v=v, q=q)
        recording = SimpleNamespace(trajectory=motion, mask=mask, name="run.csv 0-2 s")
        fit = SimpleNamespace(
            model=SimpleNamespace(joints=("a", "b")), drives=[choice],
            validation=[SimpleNamespace(recording=recording)],
        )  # fmt: skip
        first, *found = _drive_findings(fit)
        assert (first.code, first.where) == ("shape_at_bound", "b")
        assert "b: stribeck.speed is 0.0123 rad/s, the bound" in first.message
        return found

    places, speeds = said(term, other, loose)
    assert (places.code, places.where, places.evidence) == ("beyond_range", "b", {"share_pct": 4.0})
    assert places.message.startswith(
        "b: 4 % of the samples of run.csv 0-2 s have positions outside the fitted range of -0.5 "
        "to 0.8; stribeck, position is constant there"
    )
    assert speeds.evidence == {"share_pct": 8.0}
    assert (
        "8 % of the samples of run.csv 0-2 s have speeds outside the fitted range of 0 to 1;"
        in speeds.message
    )
    assert said(loose) == []


def test_all_links_weigh_within_a_factor_of_three_of_the_urdf_s():
    model = SimpleNamespace(layout=SimpleNamespace(n_inertial=20))

    def found(factor, total=None, urdf=4.0):
        prior = np.concatenate([np.arange(20.0), [7.0, 8.0]])  # two bodies, two drive terms
        prior[[0, 10]] = 0.25 * urdf, 0.75 * urdf
        standard = 5.0 + prior
        standard[[0, 10]] = urdf * factor * np.array([1.5, -0.5])
        bounds = SimpleNamespace(total=total)
        estimator = SimpleNamespace(bounds=bounds)
        return _total_mass(
            SimpleNamespace(model=model, prior=prior, standard=standard, estimator=estimator)
        )

    for factor in (1 / 2.9, 1.0, 2.9):
        assert found(factor) == []
    for factor in (-1.0, 1 / 3.1, 3.1):
        (finding,) = found(factor)
        assert (finding.code, finding.severity) == ("total_mass", "error")
        assert finding.evidence == {"urdf": 4.0, "identified": pytest.approx(4.0 * factor)}
        assert f"total mass is {4 * factor:.4g} kg, the URDF's is 4 kg" in finding.message
    assert found(3.1, total=(1.0, 20.0)) == found(3.1, urdf=0.0) == []


def test_a_body_is_in_its_box_if_all_of_its_mass_can_be():
    """Of the second of two: a bar of 2 kg along y, whose ends are at +- 0.3 m of its centre."""
    centre, half = np.array([0.1, -0.2, 0.4]), np.array([0.0, 0.3, 0.0])
    c, S = centre, np.diag(half**2) + np.outer(centre, centre)  # two points of 1 kg
    inertia = 2.0 * (np.trace(S) * np.eye(3) - S)
    i, j = (0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)
    pi = np.concatenate([np.full(10, 9.0), [2.0], 2.0 * c, inertia[i, j]])
    fit = SimpleNamespace(
        model=SimpleNamespace(layout=SimpleNamespace(bodies=("a", "b"))), standard=pi
    )
    low, high = centre - half - 0.01, centre + half + 0.01
    assert findings._is_within_box(fit, "b", np.array([low, high]))
    for k, move in ((0, 0.02), (1, 0.02), (2, 0.02)):
        for corner, sign in ((0, 1.0), (1, -1.0)):
            box = np.array([low, high])
            box[corner, k] += sign * move
            assert not findings._is_within_box(fit, "b", box), (k, corner)


def test_links_on_locked_joints_are_named_if_they_leave_their_body_hardly_possible(monkeypatch):
    """Of four bodies: barely possible and mostly locked; locked in part; possible; not locked."""
    ball = np.array([1.0, 0, 0, 0, 0.4, 0, 0.4, 0, 0, 0.4])
    held = np.concatenate([0.5 * ball, 0.15 * ball, 0.5 * ball, 0 * ball])
    rest = np.concatenate([0.05 * ball, 0.05 * ball, 0.2 * ball, 0.05 * ball])
    urdf = held + np.tile(ball, 4)
    found = held + rest
    monkeypatch.setattr(findings, "held_parameters", lambda model: held)
    layout = SimpleNamespace(n_inertial=40, bodies=tuple("abcd"))
    model = SimpleNamespace(layout=layout, standard_parameters=lambda: np.append(urdf, 7.0))
    fit = SimpleNamespace(model=model, standard=np.append(found, 9.0))
    assert findings._locked_links(fit) == (
        "the URDF's inertials of the links on locked joints, 0.5 kg of the 0.55 kg of a (identify "
        "their joints, too, if they are wrong), the URDF's inertials of the links on locked "
        "joints, 0.15 kg of the 0.2 kg of b (identify their joints, too, if they are wrong), "
    )
    held[10:20] = 0.19 * found[10:20]
    assert findings._locked_links(fit).count("the URDF's inertials") == 1


def test_what_the_user_asks_of_the_fit_is_named():
    asked = EstimatorSettings(constraints={"mass": {"a": 2.0}, "total_mass": 9.0})
    words = findings._asked(SimpleNamespace(estimator=asked))
    assert words.startswith("the constraints in [estimator] (")
    assert "mass" in words
    assert "pinned" not in words
    assert findings._asked(SimpleNamespace(estimator=EstimatorSettings())) == ""
    assert findings._asked(SimpleNamespace(estimator=EstimatorSettings("wls"))) == ""


@pytest.mark.parametrize("rank", [7, 9])
def test_a_fit_is_reported_by_its_determination_its_refitted_logs_and_costly_joints(
    monkeypatch, rank
):
    for name in ("_static_findings", "consistency_findings", "_bound_findings", "_total_mass",
                 "_impossible_shapes", "_dense_bodies", "_outlier_findings", "_drive_findings",
                 "_correlated", "encoder_findings"):  # fmt: skip
        monkeypatch.setattr(findings, name, lambda fit: [])
    monkeypatch.setattr(findings, "misfit_findings", lambda *_: ["misfit"])
    monkeypatch.setattr(findings, "_locked_links", lambda fit: "")
    monkeypatch.setattr(findings, "_asked", lambda fit: "")

    def log(path):
        return SimpleNamespace(path=path)

    def measured(rmse, error):
        return SimpleNamespace(rmse=rmse, unit="N m", relative_error_pct=error)

    own = {"a": measured(1.19, 11.0), "b": measured(2.5, None), "c": measured(0.61, 9.0),
           "d": measured(0.4, 4.9), "e": measured(0.4, 4.9), "f": measured(0.3, 5.8),
           "g": measured(0.3, 5.9), "h": measured(0.3, 19.0)}  # fmt: skip
    wls = {"a": measured(1.0, 10.0), "b": measured(2.0, 8.0), "c": measured(0.5, 7.0),
           "d": measured(0.2, 2.5), "e": measured(0.2, 2.4), "f": measured(0.2, 3.0),
           "g": measured(0.2, 3.0), "h": measured(0.2, 1.1)}  # fmt: skip
    fit = SimpleNamespace(
        overfitted={"h"},
        determination=SimpleNamespace(
            groups=() if rank == 9 else ("x",), rank=rank, names=range(9), described=lambda: "x is"
        ),
        is_poorly_excited=True,
        refitted=[
            SimpleNamespace(recording=SimpleNamespace(name=f"{k} 0-1 s", log=log(k)))
            for k in ("k.csv", "l.csv")
        ],
        metrics=lambda name="estimate": SimpleNamespace(per_joint=wls if name == "wls" else own),
    )  # fmt: skip
    found = findings.fit_findings(fit, (), (), ["other"])
    if rank == 7:
        first = found.pop(0)
        assert (first.code, first.severity) == ("undetermined", "warning")
        assert first.message.startswith("the data determine 7 of 9 base parameters: x is. ")
    assert found[:2] == ["misfit", "other"]
    refitted, costs = found[2:4], found[4:]
    assert [f.where for f in refitted] == ["k.csv", "l.csv"]
    assert "the validation log l.csv 0-1 s contains" in refitted[1].message
    assert {f.code for f in costs} == {"constraint_costs"}
    assert [(f.severity, f.where, f.evidence) for f in costs] == [
        ("warning", "b", {"error_pct": 0.0, "wls_error_pct": 8.0}),
        ("warning", "c", {"error_pct": 9.0, "wls_error_pct": 7.0}),
        ("note", "d", {"error_pct": 4.9, "wls_error_pct": 2.5}),  # 4.2 %, less than twice
        ("warning", "e", {"error_pct": 4.9, "wls_error_pct": 2.4}),
        ("note", "f", {"error_pct": 5.8, "wls_error_pct": 3.0}),  # 4.96 % of the torque
        ("warning", "g", {"error_pct": 5.9, "wls_error_pct": 3.0}),  # 5.08 %
        ("note", "h", {"error_pct": 19.0, "wls_error_pct": 1.1}),
    ]
    assert costs[6].message.endswith(
        "19 % instead of 1.1 % of the torque, which predicts unseen logs worse; no action needed"
    )
    assert costs[2].message == (
        "d: the residual is 0.4 N m, that of unconstrained WLS 0.2: 4.9 % instead of 2.5 % of the "
        "torque; no action needed"
    )
    assert costs[1].message.startswith(
        "c: the residual is 0.61 N m, that of unconstrained WLS 0.5: physics and data disagree"
    )


def ellipsoid(density, axes, centre):
    """Return the ten parameters of a homogeneous ellipsoid of three semi-axes."""
    axes, centre = np.array(axes), np.array(centre)
    mass = density * 4 / 3 * np.pi * max(np.prod(axes), 1e-6)
    moments = mass * (np.diag(axes**2) / 5 + np.outer(centre, centre))
    J = np.block([[moments, mass * centre[:, None]], [mass * centre[None], np.full((1, 1), mass)]])
    return inertial_from_pseudo_inertia(J[None])[0]


def test_bodies_denser_than_any_material_and_than_the_urdf_are_named_with_their_figures():
    sizes = [(0.1, 0.05, 0.2), (0.03, 0.04, 0.05), (0.1, 0.2, 0.0), (0.06, 0.02, 0.05)]
    centres = [(0.1, -0.3, 0.2), (0, 0, 0), (0, 0, 0), (-0.2, 0, 0)]
    before, after = (
        np.concatenate([ellipsoid(*own) for own in zip(densities, sizes, centres, strict=True)])
        for densities in ((2e3, 18e3, 1e3, 12.5e3), (20e3, 17e3, 1e3, 11.9e3))
    )
    layout = SimpleNamespace(n_inertial=40, bodies=tuple("abcd"))
    before[20:30] = ellipsoid(1e3, (0.1, 0.2, 0.3), centres[2])  # not flat
    found = _dense_bodies(
        SimpleNamespace(
            model=SimpleNamespace(layout=layout),
            prior=before,
            standard=after,
            standard_covariance=np.zeros((40, 40)),
            is_consistent=True,
            estimator=EstimatorSettings("consistent"),
        )
    )
    assert [(f.code, f.severity, f.where) for f in found] == [
        ("dense_body", "warning", "link a"), ("dense_body", "warning", "link c")
    ]  # fmt: skip
    assert found[0].evidence == pytest.approx({"mass": after[0], "density": 20e3})
    assert (
        f"the mass of a is {after[0]:.3g} kg and its inertia needs a density of at least 20000"
        in (found[0].message)
    )
    assert found[1].evidence == {"mass": after[20], "density": np.inf}
    assert "kg and its inertia is that of a body without volume" in found[1].message


@pytest.mark.parametrize(("of_mass", "severity"), [(0.02, "warning"), (0.35, "note")])
def test_a_dense_body_is_possible_if_the_errors_of_its_mass_allow_less(of_mass, severity):
    """At equal second moments the density is proportional to the mass to the power of 2.5."""
    before, after = (ellipsoid(x, (0.03, 0.04, 0.05), (0, 0, 0)) for x in (2e3, 18e3))
    mass = float(after[0])
    # the second moments stay: only the entry of the mass varies
    covariance = np.zeros((20, 20))
    covariance[10, 10] = (of_mass * mass) ** 2
    fit = SimpleNamespace(
        model=SimpleNamespace(layout=SimpleNamespace(n_inertial=20, bodies=("a", "b"))),
        prior=np.tile(before, 2), standard=np.concatenate([before, after]), is_consistent=True,
        standard_covariance=covariance, estimator=EstimatorSettings("consistent"),
    )  # fmt: skip
    (finding,) = _dense_bodies(fit)
    assert (finding.where, finding.severity) == ("link b", severity)
    largest = (12e3 / 18e3) ** 0.4 * mass
    below = scipy.stats.norm.cdf(largest, mass, of_mass * mass)
    above = 1 - scipy.stats.norm.cdf(0, mass, of_mass * mass)  # of the draws that are bodies
    share = (below - (1 - above)) / above
    found = density_share(after, covariance[10:, 10:], 12e3, np.random.default_rng(1))
    assert found == pytest.approx(share, abs=4 * np.sqrt(0.25 / 2000))
    if severity == "note":
        assert f"is {mass:.3g} +- {1.96 * of_mass * mass:.2g} kg" in finding.message
        assert "so the data do not determine this link" in finding.message


def test_errors_of_the_second_moments_allow_less_density_too():
    """The volume grows with the square root of each second moment about the centre."""
    body = ellipsoid(15e3, (0.03, 0.04, 0.05), (0, 0, 0))
    alone = np.zeros((10, 10))
    along = np.array([0, 0, 0, 0, 0.0, 0, 1, 0, 0, 1])  # mass apart along x
    moment = float(body[0]) * 0.03**2 / 5
    alone += np.outer(along, along) * (0.3 * moment) ** 2
    needed = (15e3 / 12e3) ** 2 * moment  # for a volume larger by 15 to 12
    below = scipy.stats.norm.cdf(0, moment, 0.3 * moment)
    share = scipy.stats.norm.sf(needed, moment, 0.3 * moment) / (1 - below)
    assert 0.02 < share < 0.2
    found = density_share(body, alone, 12e3, np.random.default_rng(2))
    assert found == pytest.approx(share, abs=4 * np.sqrt(share / 2000))
    assert density_share(body, np.zeros((10, 10)), 12e3, np.random.default_rng(2)) == 0.0
    assert density_share(body, np.zeros((10, 10)), 16e3, np.random.default_rng(2)) == 1.0


class Parameters(str):
    """Parameters by name, whose masses are 2 and 3 kg."""

    def __getitem__(self, part):
        return np.array([2.0, 3.0])


@pytest.mark.parametrize("of_urdf", [True, False])
def test_impossible_shapes_are_notes_if_the_urdf_or_the_box_of_the_fit_excuses_them(
    monkeypatch, of_urdf
):
    boxes = {"a": "box a", "b": "box b"}
    layout = SimpleNamespace(n_inertial=20, bodies=("a", "b"))
    model = SimpleNamespace(name="robot", layout=layout)
    after = Parameters("after")
    fit = SimpleNamespace(
        model=model, prior="before", standard=after, estimator=EstimatorSettings("consistent")
    )
    of = {
        "before": [("density", "b")] if of_urdf else [("density", "a"), ("gyration", "b")],
        "after": [("com_outside", "a"), ("density", "b")],
    }

    def audit(one, pi, points):
        assert (one, points) == (model, "points")
        return [
            Finding(c, "warning", f"link {x}", f"{c} of {x} in {pi}; advice") for c, x in of[pi]
        ]

    monkeypatch.setattr(findings, "audit_bodies", audit)
    monkeypatch.setattr(findings, "body_points", lambda one: "points")
    monkeypatch.setattr(findings, "body_boxes", lambda one: boxes)
    monkeypatch.setattr(findings, "negligible_bodies", lambda one: ())
    asked = []
    monkeypatch.setattr(findings, "_is_within_box", lambda *own: asked.append(own) or own[1] == "a")
    one, two = _impossible_shapes(fit)
    assert (one.code, one.severity, one.where) == ("com_outside", "note", "link a")
    assert one.message == (
        "as identified, com_outside of a in after; it is within the margin of the fit"
    )
    assert two.severity == ("note" if of_urdf else "warning")
    assert two.message == (
        "density of b in after; the URDF has the same fault"
        if of_urdf
        else "as identified, density of b in after. Record motion about more axes, or pin it to "
        "the URDF. The predicted torque may still be right; do not use mass, centre of mass and "
        "inertia of this link"
    )
    wanted = [(fit, "a", "box a"), *([] if of_urdf else [(fit, "b", "box b")])]
    assert asked == wanted


def test_terms_at_their_bound_and_bodies_out_of_their_box_are_named_each():
    names = tuple(f"{joint}.{term}" for joint in "abc" for term in ("viscous", "coulomb"))
    fit = SimpleNamespace(
        model=SimpleNamespace(layout=SimpleNamespace(names=names)),
        at_bound=np.array([0, 1, 1, 1, 1, 1], dtype=bool),
        estimate=SimpleNamespace(details={"relaxed": ("hand", "arm")}),
    )
    terms, hand, arm = _bound_findings(fit)
    assert (terms.code, terms.severity) == ("at_bound", "note")
    assert terms.where == ", ".join(names[1:])
    assert terms.message.startswith(
        "a.coulomb, b.viscous, b.coulomb, c.viscous, c.coulomb: 0, at the bound, without"
    )
    for finding, link in ((hand, "hand"), (arm, "arm")):
        assert (finding.code, finding.severity) == ("extent_contradicted", "warning")
        assert finding.where == f"link {link}"
        assert finding.message.startswith(f"{link}: the data contradict the box of its geometry")
