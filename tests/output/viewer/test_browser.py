"""What only a browser can show. Pages are opened from files; nothing is fetched."""

import io
from contextlib import contextmanager

import numpy as np
import pinocchio as pin
import pytest
from helpers.browsing import until
from helpers.browsing import visit as visit_large
from helpers.paths import URDF
from PIL import Image

from robotid.output.viewer.replays import Bands, Mark, Torques, replay
from robotid.robot.model import RobotModel

T = np.arange(401) / 100.0 + 7.0  # [s]
OPEN = {"reduced_motion": "reduce"}  # opens with the clock stopped
SMALL = (820, 480)  # [px] drawn faster by the processor


def predicted():
    """A fit that is off by 0.6 N m from 9 s on at joint 3, and does not know joint 4 before 8 s."""
    fit = motion(6)[1] + np.random.default_rng(1).normal(0.0, 0.1, (len(T), 6))
    fit[T >= 9.0, 3] += 0.6
    fit[T < 8.0, 4] = np.nan
    return fit


def visit(browser, target, *, size=SMALL, **options):
    return visit_large(browser, target, size=size, **options)


def motion(n):
    q = np.sin((T - T[0])[:, None] * np.linspace(0.5, 1.5, n)) + 0.2
    return q, 10.0 * np.cos(3.0 * q)


NOISE = np.full(6, 0.1)
FIT = predicted()


@pytest.fixture(scope="module")
def page(ur5, tmp_path_factory):
    q, tau = motion(6)
    pi = ur5.standard_parameters()
    heavier = pi.copy()
    heavier[10] *= 2.0
    theta = np.column_stack([np.cumsum(q[:, 0]), q[:, 1]])
    shown = replay(
        ur5, T, q,
        torques=Torques(T, tau, {"fit": FIT}, NOISE),
        masses={"URDF": pi, "fit": heavier},
        ghosts={"designed </script>": (T, q + 0.3)},
        bands=Bands(T, ["elbow.m", "wrist.m"], ["kg", "kg"], theta, 0.1 + 0 * theta),
        marks=[Mark(T[0] + 3.0, "payload <b>2 kg</b>", "payload", ur5.joints[2]),
               Mark(T[0] + 1.0, "validated", "validation")],
        log="own.csv",
    )  # fmt: skip
    return shown.write(tmp_path_factory.mktemp("page") / "replay.html")


@pytest.fixture(scope="module")
def opened(browser, page):
    """The page as it opens, once for all tests; loading it takes a second or two."""
    with visit(browser, page) as seen:
        yield seen


@pytest.fixture
def still(opened):
    """The page with its clock stopped at the start, 7 s."""
    opened.page.evaluate("replay.pause(); replay.seek(7); replay.pick(null)")
    yield opened
    assert opened.errors == []


@pytest.fixture
def playing(opened):
    """The page while its clock runs, which the processor draws as long as it does."""
    # keys are those of the page, not of a button that was clicked last
    opened.page.evaluate("document.activeElement.blur(); replay.seek(7); replay.play()")
    yield opened
    opened.page.evaluate("replay.pause()")
    assert opened.errors == []


@contextmanager
def sized(seen, width, height):
    """Show the page in a window of another size [px]."""
    seen.page.set_viewport_size({"width": width, "height": height})
    seen.page.wait_for_timeout(100)
    yield seen
    seen.page.set_viewport_size(dict(zip(("width", "height"), SMALL, strict=True)))
    seen.page.evaluate("scrollTo(0, 0)")
    seen.page.wait_for_timeout(100)


def pixels(seen):
    """Return what the 3-D view shows, shape (height, width, 3)."""
    seen.page.wait_for_timeout(120)  # a frame is drawn
    image = seen.page.screenshot(clip=seen.page.locator("#meshcat-pane").bounding_box())
    return np.asarray(Image.open(io.BytesIO(image)).convert("RGB")).astype(int)


def poses(seen, which="robot"):
    flat = seen.page.evaluate(f"replay.poses(replay.{which})")
    return [np.array(values).reshape(4, 4).T for values in flat]


def cursors(seen):
    """Return the time that the cursor of each chart in sight stands at [s]."""
    return seen.page.evaluate(
        "[...charts.link('time').seen].filter(c => c.cursor).map(c => c.plot.posToVal("
        "new DOMMatrix(getComputedStyle(c.cursor).transform).e, 'x'))"
    )


def test_the_page_loads_and_plays_without_an_error_or_a_request(opened):
    until(opened, "replay.clock.time > 7")
    assert (opened.errors, opened.requests) == ([], [])
    assert opened.page.locator("#marks li").last.inner_text() == "10.00 s: payload <b>2 kg</b>"
    assert "ghost: designed </script>" in opened.page.locator("#switches").inner_text()


def test_a_motion_without_torques_is_shown_without_an_error(browser, ur5, tmp_path):
    q, _ = motion(6)
    with visit(browser, replay(ur5, T, q).write(tmp_path / "motion.html")) as seen:
        seen.page.evaluate("replay.pause(); replay.seek(9)")
        assert seen.errors == []


def test_the_robot_is_drawn_where_pinocchio_says(still, ur5):
    q, _ = motion(6)
    data = ur5.pin_model.createData()
    for row in (0, 130, 400):
        still.page.evaluate(f"replay.seek({T[row]})")
        for which, shift in (("robot", 0.0), ("ghosts[0]", 0.3)):
            pin.forwardKinematics(ur5.pin_model, data, q[row] + shift)
            for M, drawn in zip(list(data.oMi), poses(still, which), strict=True):
                # keyframes are 1/30 s apart, and straight lines between them
                np.testing.assert_allclose(drawn, M.homogeneous, atol=2e-3)
    shown = pixels(still)
    still.page.evaluate("replay.robot.root.visible = replay.ghosts[0].root.visible = false")
    still.page.evaluate("replay.viewer.set_dirty()")
    differs = np.abs(shown - pixels(still)).max(axis=2) > 30
    still.page.evaluate("replay.robot.root.visible = replay.ghosts[0].root.visible = true")
    assert 0.01 < differs.mean() < 0.6


def test_playback_moves_the_robot_at_true_time_and_stops(playing):
    watch = "[replay.clock.time, replay.clock.at / 1000 * 0.25]"  # at: of the last frame
    playing.page.select_option("#speed", "0.25")  # or screenshots take longer than the motion
    until(playing, "replay.clock.time > 7")
    before, pose, first = playing.page.evaluate(watch), poses(playing), pixels(playing)
    playing.page.wait_for_timeout(900)
    after, second = playing.page.evaluate(watch), pixels(playing)
    assert after[0] - before[0] == pytest.approx(after[1] - before[1], abs=1e-6)
    assert after[0] - before[0] > 0.2
    assert not np.allclose(pose, poses(playing), atol=0.02)
    assert (np.abs(first - second).max(axis=2) > 30).mean() > 0.003
    playing.page.locator("body").press("Space")
    assert playing.page.locator("#play").inner_text() == "Play"
    stopped = playing.page.evaluate("replay.clock.time")
    playing.page.wait_for_timeout(200)
    assert playing.page.evaluate("replay.clock.time") == stopped
    playing.page.select_option("#speed", "1")


def test_the_motion_fills_the_view_and_the_shadow_is_below_the_lowest_points(still):
    """In a wide and in a narrow window no point of the motion is outside, one is at the rim."""
    for width in (1280, 390):
        with sized(still, width, 800) as seen:
            seen.page.click("#view")
            rims, (below, above) = seen.page.evaluate("""() => {
              const { THREE } = MeshCat, { camera } = replay.viewer;
              camera.updateMatrixWorld(true);
              const { points } = JSON.parse(document.getElementById('data').textContent).view;
              const at = points.map(([x, y, z]) => new THREE.Vector3(x, z, -y).project(camera));
              const range = v => [Math.min(...v), Math.max(...v)];
              const [all, ...parts] = ['meshcat-pane', 'models', 'tools'].map(
                id => document.getElementById(id).getBoundingClientRect());
              const covered = parts.map(c => c.width > all.width / 2 ? c.height / all.height : 0);
              return [['x', 'y'].map(k => range(at.map(p => p[k]))), covered];
            }""")
            assert np.abs(rims).max() == pytest.approx(0.9, abs=1e-3)
            assert (above > 0.05) == (width == 390)
            middle = [0.0, below - above]  # of what no control covers
            np.testing.assert_allclose(np.mean(rims, axis=1), middle, atol=0.025)
    places, opacities = seen.page.evaluate("""() => {
      const { position, color } = replay.shadow.geometry.attributes;
      return [[...position.array], [...color.array].filter((_, i) => i % 16 === 3)];
    }""")
    corners = np.array(places).reshape(-1, 4, 3)
    # the base stands on the ground, or above that of a motion that goes below it
    assert np.ptp(corners[:, :, 2]) == 0.0
    np.testing.assert_allclose(corners[0].mean(axis=0)[:2], 0.0, atol=0.02)
    assert 0.0 < min(opacities) < max(opacities) <= 0.5


def test_a_click_in_a_chart_moves_robot_slider_and_every_cursor(still):
    before = poses(still)
    still.page.locator(".plot").nth(1).scroll_into_view_if_needed()
    until(still, "document.querySelectorAll('.plot')[1].querySelector('.u-over') !== null")
    chart = still.page.locator(".plot").nth(1).locator(".u-over").first
    chart.scroll_into_view_if_needed()
    still.page.wait_for_timeout(150)  # charts that come into sight are drawn
    box = chart.bounding_box()
    still.page.mouse.click(box["x"] + 0.75 * box["width"], box["y"] + 20)
    still.page.wait_for_timeout(200)
    time = still.page.evaluate("replay.clock.time")
    assert time == pytest.approx(10.0, abs=0.05)
    assert float(still.page.locator("#time").input_value()) == pytest.approx(time, abs=1e-4)
    shown = cursors(still)
    assert len(shown) >= 2
    assert shown == pytest.approx([time] * len(shown), abs=0.02)
    assert not np.allclose(before, poses(still), atol=0.1)
    k = int(np.argmin(np.abs(T - time)))
    tau, fit = motion(6)[1][k, 1], FIT[k, 1]
    text = [b.replace("−", "-") for b in still.page.locator(".plot").nth(1).locator(
        ".keys b:not(.at)").all_inner_texts()]  # fmt: skip
    assert [float(x) for x in text] == pytest.approx([tau, fit, tau - fit], abs=2e-3)
    # the key of a mark on the time line, in the log's own time
    assert still.page.locator("#clock").inner_text() == f"{time:.2f} of 11.00 s"


def test_keys_move_the_clock_and_a_mark_is_a_button_that_picks_its_joint(still, ur5):
    seen = still
    at = lambda: seen.page.evaluate("replay.clock.time")  # noqa: E731
    seen.page.locator("#play").focus()
    seen.page.keyboard.press("ArrowRight")
    assert at() == pytest.approx(8.0)
    seen.page.locator("#time").focus()
    seen.page.keyboard.press("Shift+ArrowLeft")
    assert at() == pytest.approx(8.0 - 1 / 30)
    seen.page.keyboard.press("End")
    assert at() == pytest.approx(11.0)
    seen.page.keyboard.press("Home")
    assert at() == 7.0
    seen.page.locator("#marks button").last.click()
    assert at() == pytest.approx(10.0)
    assert seen.page.locator("#time").get_attribute("aria-valuetext") == "10.0 of 11.0 seconds"
    assert seen.page.evaluate("replay.picked") == ur5.joints[2]


def test_a_changing_time_moves_no_heading_and_reaches_charts_out_of_sight(still):
    tops = "[...document.querySelectorAll('.plot h3')].map(h => h.getBoundingClientRect().top)"
    for width in (SMALL[0], 390):
        with sized(still, width, 800) as seen:
            places = {str(seen.page.evaluate(f"replay.seek({t}), {tops}")) for t in (7, 8.5, 10.8)}
            assert len(places) == 1
    last = "replay.torqueCharts[5].chart"
    until(seen, f"{last}.at.textContent.startsWith('10.8')")
    tau = motion(6)[1][np.argmin(np.abs(T - 10.8)), 5]
    value = seen.page.evaluate(f"{last}.values[0].textContent").replace("−", "-")
    assert float(value) == pytest.approx(tau, abs=2e-3)


def test_a_narrow_page_shows_the_charts_of_one_joint(still):
    with sized(still, 390, 800) as seen:
        for node in (0, 4):
            seen.page.evaluate(f"replay.pick({node})")
            shown = [plot.locator(".explore").first.is_visible()
                     for plot in seen.page.locator(".plot").all()]  # fmt: skip
            assert shown == [j == max(node, 1) - 1 for j in range(6)]


def shows(seen, node):
    """Return what is picked in every place of the page, by nodes."""
    return seen.page.evaluate(
        """node => ({
          picked: replay.picked,
          places: [...new Set([...document.querySelectorAll('.picked')].map(e => e.dataset.node))],
          kinds: [...document.querySelectorAll('.picked')].map(e => e.tagName),
          ellipsoids: replay.masses.map(s => s.bodies.filter(b =>
            b.objects.length && b.objects.every(o => o.visible)).map(b => b.node)),
          arcs: replay.arcs.map(a => a.measured.material.opacity),
          chart: (([...document.querySelectorAll('.plot')][node - 1]).getBoundingClientRect().top
            < innerHeight)
        })""",
        node,
    )


@pytest.mark.parametrize("how", ["view", "chart", "strip", "table"])
def test_a_joint_picked_anywhere_shows_everywhere(still, ur5, how):
    seen, node = still, {"view": 2, "chart": 5, "strip": 4, "table": 3}[how]
    if how == "view":  # a point inside the link
        x, y = seen.page.evaluate("""() => {
          const { THREE } = MeshCat, joint = replay.robot.joints[2].object;
          const mesh = replay.robot.solids.find(s => s.userData.node === 2);
          replay.viewer.render();
          const box = new THREE.Box3().setFromObject(mesh), at = box.getCenter(new THREE.Vector3());
          at.project(replay.viewer.camera);
          const pane = document.getElementById('meshcat-pane').getBoundingClientRect();
          return [pane.left + (at.x + 1) / 2 * pane.width, pane.top + (1 - at.y) / 2 * pane.height];
        }""")
        seen.page.mouse.click(x, y)
    elif how == "strip":
        box = seen.page.locator("#sheet").bounding_box()
        row = box["height"] / 6
        seen.page.mouse.click(box["x"] + box["width"] * 0.75, box["y"] + 3.5 * row)
        assert seen.page.evaluate("replay.clock.time") == pytest.approx(10.0, abs=0.05)
        assert "× RMS noise" in seen.page.locator("#reading").inner_text()
        seen.page.locator("#sheet").press("ArrowUp")
        assert seen.page.evaluate("replay.picked") == ur5.joints[2]
        seen.page.locator("#sheet").press("ArrowDown")
    elif how == "chart":
        seen.page.locator(".plot h3 button").nth(node - 1).click()
    else:
        seen.page.evaluate("document.querySelector('details').open = true")
        seen.page.locator("tbody th button").nth(node - 1).click()
    found = shows(seen, node)
    assert found["picked"] == ur5.joints[node - 1]
    assert found["places"] == [str(node)]
    assert {"SECTION", "TR", "SPAN"} <= set(found["kinds"])
    assert found["ellipsoids"] == [[node], [node]]
    assert found["arcs"] == [1 if j == node - 1 else 0.25 for j in range(6)]
    assert found["chart"]
    assert seen.page.locator("#picked").inner_text() == ur5.joints[node - 1]
    seen.page.mouse.click(10, 120)  # beside the robot: none is picked
    assert seen.page.evaluate("replay.picked") is None


def test_the_heat_strip_is_the_residual_over_the_noise(still):
    seen = still
    shown = np.array(
        seen.page.evaluate("[...Array(replay.bins)].map((_, b) => "
                           "[0, 1, 2, 3, 4, 5].map(j => replay.level(b, j)))"),
        dtype=float,
    )  # fmt: skip
    bins = len(shown)
    assert bins == 100  # 401 samples, four of them in each
    edges = np.linspace(T[0], T[-1], bins + 1)
    which = np.minimum(np.searchsorted(edges, T, side="right") - 1, bins - 1)
    residual = (motion(6)[1] - FIT) / NOISE
    for b in range(0, bins, 7):
        wanted = np.sqrt(np.mean(residual[which == b] ** 2, axis=0))
        np.testing.assert_allclose(shown[b], wanted, atol=0.006)
    # a fault that does not go away shows as long as it lasts; what is not known has no value
    fault = np.arange(bins) >= 50
    assert np.nanmin(shown[fault, 3]) > 4.0
    assert np.nanmax(shown[~fault, 3]) < 3.0
    assert np.isnan(shown[:25, 4]).all()
    box = seen.page.locator("#sheet").bounding_box()
    image = np.asarray(Image.open(io.BytesIO(seen.page.screenshot(clip=box))).convert("RGB"))
    height, width = image.shape[:2]
    at = lambda x, row: image[int((row + 0.4) / 6 * height), int(x * width)].astype(int)  # noqa: E731
    before, faulty, sound = at(0.4, 3), at(0.8, 3), at(0.8, 2)
    assert faulty[0] > faulty[2] + 100  # red
    assert before[2] > before[0] + 20
    assert sound[2] > sound[0] + 20


def test_axe_finds_no_fault(browser, page):
    from axe_playwright_python.sync_playwright import Axe

    # axe is put in from outside, which the page's own policy forbids
    with visit(browser, page, bypass_csp=True, **OPEN) as seen:
        assert seen.page.evaluate("replay.clock.time") == 8.0  # at the mark of the validated part
        seen.page.evaluate("replay.pick(3)")
        for scheme, rules in (
            ("light", {"type": "tag", "values": ["wcag2a", "wcag2aa"]}),
            ("dark", {"type": "rule", "values": ["color-contrast"]}),  # the rest is as before
        ):
            seen.page.emulate_media(color_scheme=scheme)
            found = Axe().run(seen.page, options={"runOnly": rules}).response
            faults = {v["id"]: [n["html"][:200] for n in v["nodes"]] for v in found["violations"]}
            assert faults == {}
            assert len(found["passes"]) > 10 or scheme == "dark"
            assert found["passes"]
        assert seen.errors == []


TIMES = np.linspace(3.0, 5.0, 200)  # [s]
SIZES = {"identified": 0.1, "URDF + drives": 0.3, "URDF": 0.6}  # [N m] residuals


@pytest.fixture(scope="module")
def choices(tmp_path_factory):
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf")
    q = np.column_stack([np.sin(TIMES), np.cos(TIMES)])
    tau = 5.0 * q
    predicted = {label: tau + size for label, size in SIZES.items()}
    torques = Torques(TIMES, tau, predicted, np.array([0.1, 0.2]))
    shown = replay(model, TIMES, q, torques=torques, log="second.csv")
    return shown.write(tmp_path_factory.mktemp("choice") / "replay.html")


@pytest.fixture(scope="module")
def seen(browser, choices):
    with visit(browser, choices, size=(900, 620), reduced_motion="reduce") as opened:
        opened.page.locator(".plot").first.scroll_into_view_if_needed()
        until(opened, "replay.torqueCharts[0].below.plot !== null")
        yield opened
        assert opened.errors == []


def shown(seen):
    """Return the mean residual that chart, strip and arc show of the first joint [N m]."""
    return seen.page.evaluate(
        """() => {
          const { chart, below } = replay.torqueCharts[0];
          const labels = chart.what.series.map((s) => s.label);
          const visible = labels.filter((_, i) => !chart.hidden.has(i)), [residual] = below.ys;
          replay.seek(4);
          return { visible, chart: residual.reduce((a, b) => a + b) / residual.length,
            strip: 0.1 * replay.level(10, 0),
            colour: replay.arcs[0].measured.material.color.getStyle() };
        }"""
    )


@pytest.mark.parametrize("label", ["URDF", "URDF + drives", "identified"])
def test_charts_strip_and_arcs_show_the_selected_prediction(seen, label):
    seen.page.get_by_label(label, exact=True).check()
    found = shown(seen)
    assert found["visible"] == ["measured", label]
    assert found["chart"] == pytest.approx(-SIZES[label], abs=1e-3)
    assert found["strip"] == pytest.approx(SIZES[label], abs=2e-3)
    share = SIZES[label] / 0.1 / 6.0  # of the full scale: blue, yellow, red
    red = 255 if share >= 0.5 else 43 + 2 * share * (255 - 43)
    red -= max(0.0, 2 * share - 1) * (255 - 215)
    assert int(found["colour"][4:].split(",")[0]) == pytest.approx(red, abs=1.5)
