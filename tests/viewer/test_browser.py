"""What only a browser can show. Pages are opened from files; nothing is fetched."""

import io
import os
import signal
import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest
from helpers.browsing import until
from helpers.browsing import visit as visit_large
from helpers.synthetic import payload_log
from PIL import Image

from robotid.logs.read import write_log
from robotid.viewer.replays import Bands, Mark, Torques, replay

T = np.arange(401) / 100.0 + 7.0  # [s]
OPEN = {"reduced_motion": "reduce"}  # opens with the clock stopped
SMALL = (820, 480)  # [px] drawn faster by the processor


def visit(browser, target, *, size=SMALL, **options):
    return visit_large(browser, target, size=size, **options)


def motion(n):
    q = np.sin((T - T[0])[:, None] * np.linspace(0.5, 1.5, n)) + 0.2
    return q, 10.0 * np.cos(3.0 * q)


@pytest.fixture(scope="module")
def page(ur5, tmp_path_factory):
    q, tau = motion(6)
    pi = ur5.standard_parameters()
    heavier = pi.copy()
    heavier[10] *= 2.0
    theta = np.column_stack([np.cumsum(q[:, 0]), q[:, 1]])
    shown = replay(
        ur5, T, q,
        torques=Torques(T, tau, {"fit": 0.9 * tau}),
        masses={"URDF": pi, "fit": heavier},
        ghost=("designed </script>", T, q + 0.3),
        bands=Bands(T, ["elbow.m", "wrist.m"], ["kg", "kg"], theta, 0.1 + 0 * theta),
        marks=[Mark(T[0] + 3.0, "payload <b>2 kg</b>", "payload")],
    )  # fmt: skip
    return shown.write(tmp_path_factory.mktemp("page") / "replay.html")


@pytest.fixture(scope="module")
def opened(browser, page):
    with visit(browser, page, **OPEN) as seen:
        yield seen


@pytest.fixture
def still(opened):
    """The page with its clock stopped at 0; loading it takes the processor a second or two."""
    opened.page.evaluate("replay.pause(); replay.seek(0)")
    yield opened
    assert opened.errors == []


def pixels(seen):
    """Return what the 3-D view shows, shape (height, width, 3)."""
    seen.page.wait_for_timeout(120)  # a frame is drawn
    image = seen.page.screenshot(clip=seen.page.locator("#meshcat-pane").bounding_box())
    return np.asarray(Image.open(io.BytesIO(image)).convert("RGB")).astype(int)


def poses(seen, which="robot"):
    flat = seen.page.evaluate(f"replay.poses(replay.{which})")
    return [np.array(values).reshape(4, 4).T for values in flat]


def cursors(seen):
    """Return the time that each plot's cursor stands at [s]."""
    return seen.page.evaluate(
        "replay.plots.map(p => { const m = new DOMMatrix(getComputedStyle(p.cursor).transform);"
        " return p.chart.posToVal(m.e, 'x'); })"
    )


def test_the_page_loads_without_an_error_or_a_request(browser, page):
    with visit(browser, page) as seen:
        seen.page.wait_for_timeout(300)
        assert seen.errors == []
        assert seen.requests == []
        assert seen.page.locator("#marks li").inner_text() == "3.00 s: payload <b>2 kg</b>"
        assert "ghost: designed </script>" in seen.page.locator("#switches").inner_text()


def test_the_robot_is_drawn_where_pinocchio_says(still, ur5):
    q, _ = motion(6)
    data = ur5.pin_model.createData()
    seen = still
    for row in (0, 130, 400):
        seen.page.evaluate(f"replay.seek({T[row] - T[0]})")
        for which, shift in (("robot", 0.0), ("ghost", 0.3)):
            pin.forwardKinematics(ur5.pin_model, data, q[row] + shift)
            for M, drawn in zip(list(data.oMi), poses(seen, which), strict=True):
                # keyframes are 1/30 s apart, and straight lines between them
                np.testing.assert_allclose(drawn, M.homogeneous, atol=2e-3)
    shown = pixels(seen)
    seen.page.evaluate("replay.robot.root.visible = replay.ghost.root.visible = false")
    seen.page.evaluate("replay.viewer.set_dirty()")
    differs = np.abs(shown - pixels(seen)).max(axis=2) > 30
    seen.page.evaluate("replay.robot.root.visible = replay.ghost.root.visible = true")
    assert 0.01 < differs.mean() < 0.6


def test_playback_moves_the_robot_at_true_time_and_stops(browser, page):
    with visit(browser, page) as seen:
        watch = "[replay.clock.time, replay.clock.at / 1000 * 0.25]"  # at: of the last frame
        seen.page.select_option("#speed", "0.25")  # or screenshots take longer than the motion
        seen.page.wait_for_timeout(100)
        before, pose, first = seen.page.evaluate(watch), poses(seen), pixels(seen)
        seen.page.wait_for_timeout(900)
        after, second = seen.page.evaluate(watch), pixels(seen)
        assert after[0] - before[0] == pytest.approx(after[1] - before[1], abs=1e-6)
        assert after[0] - before[0] > 0.2
        assert not np.allclose(pose, poses(seen), atol=0.02)
        assert (np.abs(first - second).max(axis=2) > 30).mean() > 0.003
        seen.page.locator("body").press("Space")
        assert seen.page.locator("#play").inner_text() == "Play"
        stopped = seen.page.evaluate("replay.clock.time")
        seen.page.wait_for_timeout(200)
        assert seen.page.evaluate("replay.clock.time") == stopped


def test_speed_and_loop(browser, page):
    with visit(browser, page, **OPEN) as seen:
        seen.page.select_option("#speed", "10")
        seen.page.click("#play")
        seen.page.wait_for_timeout(1000)  # 10 s of a motion of 4 s
        assert seen.page.evaluate("replay.clock.playing")
        seen.page.uncheck("#loop")
        until(seen, "!replay.clock.playing")
        assert seen.page.evaluate("replay.clock.time") == pytest.approx(4.0, abs=1e-6)


def test_a_click_in_a_plot_moves_robot_slider_and_every_cursor(still):
    seen = still
    before = poses(seen)
    plot = seen.page.locator(".plot .u-over").nth(1)
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    seen.page.mouse.click(box["x"] + 0.75 * box["width"], box["y"] + 20)
    seen.page.wait_for_timeout(100)
    time = seen.page.evaluate("replay.clock.time")
    assert time == pytest.approx(3.0, abs=0.05)
    assert float(seen.page.locator("#time").input_value()) == pytest.approx(time)
    assert cursors(seen) == pytest.approx([time] * 7, abs=0.02)  # 6 joints, 1 parameter
    assert not np.allclose(before, poses(seen), atol=0.1)
    text = seen.page.locator(".plot output").nth(1).inner_text()
    tau = np.interp(time, T - T[0], motion(6)[1][:, 1])
    measured, fit = (float(word) for word in text.replace("N m", "").split("/"))
    assert measured == pytest.approx(tau, abs=0.3)
    assert fit == pytest.approx(0.9 * measured, abs=0.02)


def test_keys_move_the_clock_and_a_mark_is_a_button(still):
    seen = still
    at = lambda: seen.page.evaluate("replay.clock.time")  # noqa: E731
    seen.page.keyboard.press("ArrowRight")
    assert at() == pytest.approx(1.0)
    seen.page.locator("#time").focus()
    seen.page.keyboard.press("Shift+ArrowLeft")
    assert at() == pytest.approx(1.0 - 1 / 30)
    seen.page.keyboard.press("End")
    assert at() == pytest.approx(4.0)
    seen.page.click("#marks button")
    assert at() == pytest.approx(3.0)
    assert seen.page.locator("#time").get_attribute("aria-valuetext") == "3.0 of 4.0 seconds"


def test_a_link_s_ellipsoid_is_shown_by_its_name(still):
    seen = still
    shown = pixels(seen)
    box = seen.page.get_by_label("fit: upper_arm_link, 16.8 kg")
    assert box.is_checked()
    box.uncheck()
    seen.page.get_by_label("URDF: upper_arm_link, 8.39 kg").uncheck()
    assert (np.abs(shown - pixels(seen)).max(axis=2) > 10).mean() > 0.0005


def test_arcs_take_the_colour_of_the_residual(browser, ur5, tmp_path):
    q, _ = motion(6)
    constant = np.full((len(T), 6), 10.0)
    # all of it is predicted at first, then half of it, and at last nothing is known
    fit = constant * np.select([T[0] + 1 > T, T[0] + 2 > T], [1.0, 0.5], np.nan)[:, None]
    shown = replay(ur5, T, q, torques=Torques(T, constant, {"fit": fit}))
    colours = {"blue": [43, 131, 186], "red": [215, 25, 28], "grey": [138, 151, 165]}
    with visit(browser, shown.write(tmp_path / "r.html"), **OPEN) as seen:
        for time, wanted in ((0.5, "blue"), (1.5, "red"), (3.0, "grey")):
            seen.page.evaluate(f"replay.seek({time})")
            image = pixels(seen)
            count = {c: (abs(image - rgb).max(axis=2) < 10).sum() for c, rgb in colours.items()}
            assert count[wanted] > 100
            assert wanted == "grey" or all(count[c] < 20 for c in ("blue", "red") if c != wanted)
            assert wanted != "grey" or count["blue"] + count["red"] < 20


def test_a_phone_shows_everything_without_scrolling_sideways(browser, page):
    with visit(browser, page, size=(390, 844), **OPEN) as seen:
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= 390
        assert seen.page.locator("#play").is_visible()
        drawn = pixels(seen)
        assert np.ptp(drawn.reshape(-1, 3), axis=0).max() > 60
        seen.page.locator(".plot").last.scroll_into_view_if_needed()
        assert seen.errors == []


def test_every_control_has_a_name(still):
    seen = still
    named = seen.page.evaluate(
        "[...document.querySelectorAll('button:not([hidden]), input, select')].map(e => "
        "(e.labels && e.labels.length && e.labels[0].innerText.trim()) || "
        "e.getAttribute('aria-label') || e.innerText.trim())"
    )
    assert len(named) > 15
    assert all(named)


def test_a_notebook_s_frame_plays(browser, ur5, tmp_path):
    cell = tmp_path / "notebook.html"
    cell.write_text(f"<title>n</title>{replay(ur5, T, motion(6)[0])._repr_html_()}")
    with visit(browser, cell) as seen:
        inside = seen.page.frame_locator("iframe")
        inside.locator("#clock").wait_for()
        seen.page.wait_for_timeout(500)
        assert inside.locator("#play").inner_text() == "Pause"
        assert not inside.locator("#clock").inner_text().startswith("0.00 ")
        assert [e for e in seen.errors if "sandbox" not in e] == []


# the command as it is, but the page is told nothing after 6 s of the log until a file is there
HELD = """
import pathlib, runpy, time
from robotid.viewer.server import LivePage
send = LivePage.send
def held(self, message):
    while message.get("t", 0.0) > 6.0 and not pathlib.Path("go on").exists():
        time.sleep(0.02)
    send(self, message)
LivePage.send = held
runpy.run_module("robotid", run_name="__main__", alter_sys=True)
"""


def test_the_live_page_follows_a_running_tracker_and_ends_on_ctrl_c(browser, panda, tmp_path):
    log = payload_log(panda, np.random.default_rng(0), duration=12.0, at=10.0)
    write_log(log, tmp_path / "log.csv")
    words = ["track", str(panda.tree.path), "log.csv", "--joints", ",".join(panda.joints)]
    run = subprocess.Popen(
        [sys.executable, "-c", HELD, *words, "--out", "out", "--serve", "--speed", "3"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    try:
        address = run.stderr.readline().split()[1]
        assert address.startswith("http://127.0.0.1:")
        with visit(browser, address) as seen:
            until(seen, "replay.clock.time > 1.5", 120.0)
            assert seen.page.locator("#state").inner_text() == "live"
            early = seen.page.evaluate("replay.clock.time")
            assert early <= 6.0
            (tmp_path / "go on").touch()
            until(seen, f"replay.clock.time > {early + 1}", 120.0)
            until(seen, "document.getElementById('state').textContent.includes('finished')", 120.0)
            # the page shows the last pose of the log
            assert seen.page.evaluate("replay.clock.time") == pytest.approx(12.0, abs=0.05)
            data = panda.pin_model.createData()
            pin.forwardKinematics(panda.pin_model, data, panda.configurations(log.q[-1:])[0])
            np.testing.assert_allclose(poses(seen)[-1], data.oMi[-1].homogeneous, atol=0.05)
            assert "step change" in seen.page.locator("#marks").inner_text()
            assert " / " in seen.page.locator(".plot output").first.inner_text()
            assert seen.errors == []
            assert seen.requests == [f"{address}events"]
        assert (tmp_path / "out" / "track.json").is_file()
        run.send_signal(signal.SIGINT)
        assert run.wait(60) == 0
        assert "Traceback" not in run.stderr.read()
        assert "step change at" in run.stdout.read()
    finally:
        run.kill()
        run.wait()
        run.stderr.close()
        run.stdout.close()
