import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.pages import chart

from robotid.design import course as course_of_motions
from robotid.design.basis import FourierBasis
from robotid.design.clearance import Box, Clearance, Contact
from robotid.design.course import Course
from robotid.design.design import Designer
from robotid.design.limits import LIMITS, MotionLimits
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.prediction import predict_instants
from robotid.output.report import motion_page
from robotid.output.report.motion_page import (
    _collisions,
    _distance_chart,
    _expected,
    _free_chart,
    _head,
    _history,
    _limit_table,
    _share_chart,
)
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

WRIST = ["wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]


@pytest.fixture(scope="module")
def course():
    """A motion of the last three joints of a UR10, between a post and a floor."""
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), joints=WRIST)
    limits = MotionLimits.of_model(model, acceleration={"wrist_2_joint": 4.0})
    post = Box("post", (1.2, 0.1, -0.5), (1.3, 0.2, 0.5))
    around = Clearance(model, least=0.03, floor=-0.5, boxes=[post])
    designer = Designer.of_model(model, FourierBasis(4.0, 3), limits)
    fine = replace(designer, finer=10)
    design = fine.checked(designer.random(np.random.default_rng(0)))
    return model, designer, design, Course.of_design(replace(designer, clearance=around), design)


def test_a_course_has_the_values_of_the_motion_and_shares_of_its_limits(course):
    model, _, design, found = course
    q, v, a, jerk = design.motion.basis.derivatives(found.t, 3) @ design.motion.coefficients
    np.testing.assert_allclose(found.values[:3], [q, v, a], atol=1e-12)
    np.testing.assert_allclose(found.values[3][1:-1], jerk[1:-1], atol=0.01)  # by differences
    np.testing.assert_allclose(found.values[5], found.values[4] * v, atol=1e-12)
    speeds = np.array([j.velocity for j in model.limits])
    np.testing.assert_allclose(found.used[1], v / (0.9 * speeds), atol=1e-12)
    kinds = [k for k, kind in enumerate(LIMITS) if kind != "jerk"]
    np.testing.assert_allclose(found.largest[kinds], design.used[kinds], rtol=1e-9)
    assert np.abs(found.largest - design.used).max() < 0.01  # jerk by differences
    k = LIMITS.index("acceleration")
    assert found.largest[k, 0] == 0.0  # it has no limit
    at = found.peak("acceleration", 1)
    peak = np.abs(design.motion.evaluate(np.array([at]))[2][0, 1])
    assert peak == pytest.approx(4.0 * found.largest[k, 1], rel=1e-9)
    signs = set()
    for kind, used in zip(LIMITS, found.used, strict=True):  # the largest, of either sign
        for j in range(3):
            at = used[found.t == found.peak(kind, j), j]
            assert np.abs(at) == np.abs(used[:, j]).max()
            signs |= set(np.sign(at))
    assert {-1.0, 1.0} <= signs


def test_torques_of_a_course_are_those_of_the_bodies_and_the_friction_assumed(course):
    model, designer, _, found = course
    q, v, a = found.values[:3]
    still = found.values[4] - predict_instants(model, model.standard_parameters(), q, v, a)
    size = np.abs(still).max(axis=0)
    assert (size > 0.02 * 54.0).all()  # friction of 5 %, at each joint, for 54 N m
    assert (size < 0.15 * 54.0).all()
    assert designer.limits.sizes[4] == pytest.approx(0.9 * np.array([54.0, 54.0, 54.0]))


def test_the_distance_of_a_course_is_that_of_all_pairs(course):
    *_, found = course
    around = found.clearance
    poses = around.placed(found.values[0])
    exact = around.near(poses, np.inf, around.everything).distance
    distance, pairs = found.nearness(around.everything)
    np.testing.assert_allclose(distance, exact.min(axis=0), atol=1e-9)
    np.testing.assert_array_equal(exact[pairs, np.arange(len(distance))], exact.min(axis=0))
    margins = (exact - around.required[:, None])[found.changes(around)]
    assert found.nearest.margin == pytest.approx(margins.min())
    assert found.nearest.time == found.t[np.unravel_index(margins.argmin(), margins.shape)[1]]
    floor = np.array(["the floor" in pair for pair in around.named])
    assert exact[floor].min() > 0.2  # farther than what is looked at first
    np.testing.assert_allclose(found.nearness(floor)[0], exact[floor].min(axis=0), atol=1e-9)
    assert found.changes(around).all()
    turned = found.values.copy()
    turned[0, :, :2] = turned[0, 0, :2]  # the last joint moves alone
    last = [any("wrist_3" in name or "ee_" in name for name in pair) for pair in around.named]
    changes = replace(found, values=turned).changes(around)
    assert changes.any()
    assert not changes[~np.array(last)].any()
    nothing = np.zeros(len(around.pairs), dtype=bool)
    assert np.isinf(found.nearness(nothing)[0]).all()


def test_distances_that_do_not_change_are_not_drawn(course):
    model, *_, found = course
    around, values = found.clearance, found.values[:, ::10].copy()
    values[0, :, :2] = values[0, 0, :2]  # the last joint moves alone
    turned = replace(found, t=found.t[::10], values=values)
    what = chart(_distance_chart(model, turned, around), "distance of the two nearest hulls")
    changes = turned.changes(around)
    exact = around.near(around.placed(values[0]), np.inf, around.everything).distance
    links = np.array([set(pair) <= set(model.tree.links) for pair in around.named])
    near = np.isfinite(around.slack)
    assert (~changes & ~links).any()
    shown = {series["label"]: series["y"] for series in what["series"]}
    np.testing.assert_allclose(shown.pop("clearance"), 30.0, rtol=1e-3)
    wanted = {"links": links & ~near, "floor and boxes": ~links, "links close by design": near}
    wanted = {label: own & changes for label, own in wanted.items() if (own & changes).any()}
    assert list(shown) == list(wanted)
    for label, own in wanted.items():
        np.testing.assert_allclose(shown[label], 1e3 * exact[own].min(axis=0), rtol=2e-3)


def test_the_nearest_pair_is_that_of_the_smallest_margin_not_distance(course, monkeypatch):
    found = replace(course[-1])  # nothing kept
    around = found.clearance
    exact = around.near(around.placed(found.values[0]), np.inf, around.everything).distance
    least = exact.min(axis=1)
    far = int(np.argsort(least)[len(least) // 2])
    assert least[far] > least.min() + 0.03
    required = np.full(len(least), least.min() - 0.02)
    required[far] = least[far] - 0.01
    monkeypatch.setattr(around, "required", required)
    assert (found.nearest.first, found.nearest.second) == around.named[far]
    assert found.nearest.distance == pytest.approx(least[far])
    assert found.nearest.margin == pytest.approx(0.01)
    assert found.nearest.time == found.t[exact[far].argmin()]


def test_the_page_states_the_distance_between_links_beside_the_required_one():
    entry = {
        "margin": 0.012, "kept": 0.03, "where": "forearm and post", "time": 1.5, "unread": [],
        "left_alone": [], "built_near": [],
    }  # fmt: skip
    course = SimpleNamespace(nearest=None, clearance=object())
    assert _collisions({"limits": {"collision": entry}}, course) == (
        "<p>Smallest margin to a collision: forearm and post, distance 42 mm at 1.50 s. Required: "
        "30 mm, also between the samples.</p>\n"
    )


def test_distances_of_a_long_motion_are_looked_at_less_often(course, monkeypatch):
    *_, found = course
    t = np.linspace(0.0, 60.0, 6001)
    values = np.arange(6.0 * 6001 * 3).reshape(6, 6001, 3)
    few = replace(found, t=t, values=values).thinned
    np.testing.assert_array_equal(few.t, t[::7])
    np.testing.assert_array_equal(few.values, values[:, ::7])
    assert len(found.thinned.t) == len(found.t)
    monkeypatch.setattr(course_of_motions, "_MOST", 60)
    few = replace(found)  # nothing kept
    step = round(len(found.t) / len(few.thinned.t))
    assert step > 1
    distances = found.clearance.near(
        found.clearance.placed(few.thinned.values[0]), np.inf, found.clearance.everything
    ).distance
    k = np.unravel_index((distances - found.clearance.required[:, None]).argmin(), distances.shape)
    assert few.nearest.time == found.t[::step][k[1]] > 0.0


def test_the_least_certain_base_parameters_have_their_own_names(ur5):
    mapping = structural_mapping(ur5)
    error = np.full(len(mapping.base_names), 0.01)
    error[[7, 30]] = 0.9, 0.7
    preview = SimpleNamespace(
        expected=SimpleNamespace(mapping=mapping, model=ur5, sources=("data", "prior")),
        noise=SimpleNamespace(std=np.ones(6), origins=("stated",)),
        base_error=error, plausible=np.ones(len(error)), words="30 s",
    )  # fmt: skip
    first, second = (mapping.base_names[k] for k in (7, 30))
    assert mapping.names[7] != first
    assert f"Largest, in % of the plausible range: {first} 90 %, {second} 70 %." in _expected(
        preview
    )


def test_the_page_states_use_margin_joint_time_value_and_unit_of_each_limit():
    """A rail, which is prismatic, carries an elbow."""
    t = 3.0 + 0.25 * np.arange(9)
    used = np.zeros((6, 9, 2))
    used[0, 2, 1], used[1, 7, 0], used[4, 4, 0], used[2, 1, 1] = -0.8, 0.613, -0.475, 0.25
    sizes = np.array([[0.5, 2.9], [0.4, 3.15], [7.0, 11.0], [np.inf] * 2, [900.0, 150.0],
                      [np.inf] * 2])  # fmt: skip
    model = SimpleNamespace(joints=("rail", "elbow"), layout=SimpleNamespace(prismatic=("rail",)))
    course = Course(t, used, MotionLimits(np.zeros(2), sizes))
    course.__dict__["used"] = used
    entries = {"position": ("elbow", 0.2), "velocity": ("rail", 0.387), "torque": ("rail", 0.525),
               "acceleration": ("elbow", 0.75)}  # fmt: skip
    content = {"limits": {k: {"where": x, "margin": y} for k, (x, y) in entries.items()},
               "share": 0.85}  # fmt: skip
    found = _limit_table(model, content, course)
    rows = [re.sub(r"<[^>]+>", "|", row) for row in found.split("<tr>")]
    texts = ([y.strip() for y in row.split("|") if y.strip()] for row in rows)
    cells = {x[0]: x[1:7] for x in texts if len(x) > 4}
    assert cells["position"] == ["80.0", "20.0", "elbow", "3.50", "2.9", "rad"]
    assert cells["velocity"] == ["61.3", "38.7", "rail", "4.75", "0.4", "m/s"]
    assert cells["torque"] == ["47.5", "52.5", "rail", "4.00", "900", "N"]
    assert cells["acceleration"] == ["25.0", "75.0", "elbow", "3.25", "11", "rad/s²"]
    assert "100 % of position, velocity and torque is 85 % of the URDF's limit" in found
    assert "Collisions were not checked" in found
    assert "torque [N m or N]" in _free_chart(model, course, "torque", np.array([0, 1]))
    assert "torque [N]" in _free_chart(model, course, "torque", np.array([0]))
    assert "acceleration [rad/s²]" in _free_chart(model, course, "acceleration", np.array([1]))
    used[4, 5, 1], used[4, 6, 0] = 0.3, 0.35
    shares = chart(_share_chart(model, course, "torque", np.array([1, 0])), "torque of each joint")
    shown = {series["label"]: series["y"] for series in shares["series"]}
    assert list(shown) == ["limit", "−limit", "elbow", "rail"]
    np.testing.assert_allclose(shares["x"], t, rtol=1e-3)
    wanted = [np.full(9, 100.0), np.full(9, -100.0), 100 * used[4, :, 1], 100 * used[4, :, 0]]
    np.testing.assert_allclose([*shown.values()], wanted, atol=0.01)


def test_the_page_counts_parameters_by_their_expected_error_and_source(ur5):
    mapping = structural_mapping(ur5)
    plausible = np.linspace(0.5, 4.0, len(mapping.base_names))
    ratio = np.full(len(plausible), 0.3)
    ratio[:4], ratio[[10, 12, 20]] = 0.05, [0.51, 1.7, 0.62]
    preview = SimpleNamespace(
        expected=SimpleNamespace(
            mapping=mapping, model=ur5, sources=("data", "prior", "data", "mixed", "data")
        ),
        noise=SimpleNamespace(
            std=np.array([0.1, 2.34, 3, 4, 5, 6]), origins=("stated", "log", "stated")
        ),
        base_error=ratio * plausible, plausible=plausible, words="30 s at 100 Hz",
    )  # fmt: skip
    found = _expected(preview)
    names = [mapping.base_names[k] for k in (12, 20, 10)]
    assert "<p>30 s at 100 Hz.</p>" in found
    assert (
        f"Of {len(ratio)} base parameters, 4 have an expected standard error below 10 % of their "
        "plausible range, 3 above 50 %." in found
    )
    assert f"Largest, in % of the plausible range: {names[0]} 100 %, {names[1]} 62 %, {names[2]} " \
        "51 %." in found  # fmt: skip
    sources = "3 by the motion, 1 by the URDF alone, 1 by motion and URDF together"
    assert f"The standard parameters will be determined: {sources}." in found
    assert f"{ur5.joints[0]} 0.1, {ur5.joints[1]} 2.3, {ur5.joints[2]} 3" in found


def test_collisions_of_the_page_have_millimetres_and_what_was_not_checked():
    contact = Contact("forearm", "base", 0.0437, 2.346, 0.0301)
    entry = {"margin": None, "kept": 0.05, "where": "x", "time": 0.0, "unread": ["gripper", "cam"],
             "left_alone": ["a and b"], "built_near": ["c and d"]}  # fmt: skip
    found = _collisions(
        {"limits": {"collision": entry}}, SimpleNamespace(nearest=contact, clearance=object())
    )
    assert "forearm and base, distance 44 mm at 2.35 s. Required: 30 mm." in found
    assert "Not checked, since no shape can be read: gripper, cam." in found
    assert "Not checked, since in contact by design: a and b." in found
    assert "Close by design, with a smaller clearance: c and d." in found


def test_the_head_and_the_course_of_the_optimisation_have_the_figures_of_the_design():
    model = SimpleNamespace(name="a<b", joints=("one", "two", "three"))
    content = {
        "kind": "bspline", "duration": 12.3456, "criterion": "E", "condition_number": 1234.5,
        "seconds": 7.89, "starts": 1, "converged": True,
        "history": [[0.5, 3.25], [1.25, 2.5], [4.0, -1.75]],
    }  # fmt: skip

    def facts(**changes):
        head = _head(model, content | changes)
        assert head.startswith("<h1>a&lt;b: excitation trajectory</h1>")
        return dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", head))

    assert facts() == {
        "motion": "bspline, 12.35 s", "joints": "3", "criterion": "E",
        "condition number": "1,234 (regressor, columns in units of the prior)",
        "computing time": "7.9 s, 1 start, converged",
    }  # fmt: skip
    other = facts(condition_number=None, starts=3, converged=False)
    assert other["condition number"] == "infinite"
    assert other["computing time"] == "7.9 s, 3 starts, not converged: allow more seconds"
    assert facts(starts=0)["computing time"] == "7.9 s"
    what = chart(_history(content), "criterion of the best motion against the computing time")
    np.testing.assert_allclose(what["x"], [0.5, 1.25, 4.0], atol=1e-3)
    np.testing.assert_allclose(what["series"][0]["y"], [3.25, 2.5, -1.75], atol=1e-3)


@pytest.mark.parametrize(("gain", "is_shown"), [(1.1e-3, True), (9e-4, False)])
def test_the_page_has_limits_course_errors_and_a_search_that_got_better(
    monkeypatch, tmp_path, gain, is_shown
):
    model, course = SimpleNamespace(name="a<b", joints=("one",)), object()
    content = {
        "kind": "fourier", "duration": 4.0, "criterion": "D", "condition_number": 7.0,
        "seconds": 2.0, "starts": 1, "converged": True, "history": [[0.5, 3.0], [1.0, 3.0 - gain]],
    }  # fmt: skip

    def of_course(words):
        def shown(*given):
            assert given == (model, content, course)
            return f"<p>{words}</p>"

        return shown

    monkeypatch.setattr(motion_page, "_limit_table", of_course("uses"))
    monkeypatch.setattr(motion_page, "_over_time", of_course("runs"))
    target = tmp_path / "page.html"
    found = motion_page.write_motion_page(target, model, content, course, ["b < 3 g"])
    assert found == target
    shown = target.read_text()
    parts = ["a&lt;b: excitation trajectory</title>", "<h1>", ">Smallest margin to each limit<",
             "<p>uses</p>", ">Course over time<", "<p>runs</p>", ">Expected standard errors<",
             "b &lt; 3 g"]  # fmt: skip
    places = [shown.rindex(part) for part in parts]
    assert places == sorted(places)
    assert (">Course of the optimisation<" in shown) == is_shown


def test_each_limit_has_a_chart_of_its_joints_and_some_quantities_without_one(monkeypatch):
    """Position is limited of all joints, torque of two, power of one, the others of none."""
    sizes = np.full((len(LIMITS), 3), np.inf)
    sizes[LIMITS.index("position")] = sizes[LIMITS.index("torque"), [0, 2]] = 1.0
    sizes[LIMITS.index("power"), 1] = 1.0
    course = SimpleNamespace(limits=SimpleNamespace(sizes=sizes), clearance=None, nearest=None)
    for word in ("share", "free"):
        monkeypatch.setattr(
            motion_page, f"_{word}_chart",
            lambda model, course, kind, joints, word=word: f"{word} {kind} {joints.tolist()};",
        )  # fmt: skip
    monkeypatch.setattr(motion_page, "_distance_chart", lambda *given: f"distance {given[2]}")
    shown = ["share position [0, 1, 2];", "free acceleration [0, 1, 2];", "share torque [0, 2];",
             "free torque [1];", "share power [1];"]  # fmt: skip
    for nearest, clearance, last in (
        (None, None, ""), (None, "around", ""), ("contact", None, ""),
        ("contact", "around", "distance around"),
    ):  # fmt: skip
        course.nearest, course.clearance = nearest, clearance
        found = motion_page._over_time("model", {}, course)
        assert found == f'<div class="plots">\n{"".join(shown)}{last}</div>\n'
