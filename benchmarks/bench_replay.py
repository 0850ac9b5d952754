"""Size, load time and frames per second of replay pages, in the system's Chromium.

60 s logged at 1 kHz, played by itself and with everything that a page can show. Without a graphics
card the processor draws; what it has left beside other work decides, so its time per frame is
printed too, and the share of a core that a paused page needs.
"""

import argparse
import os
import platform
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from helpers.browsing import FLAGS, NAMES

from robotid.output.viewer.replays import Torques, replay
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FRAMES = "[replay.clock.frames, replay.clock.at / 1000]"


def pages(seconds):
    """Yield a name and a page: of an arm a motion alone, then all; of a quadruped all."""
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"))
    t = np.arange(1000 * seconds) / 1000.0
    speeds = np.array([0.5, 0.4, 0.6, 0.7, 1.0, 1.2])
    q = 0.8 * np.sin(t[:, None] * speeds) + np.array([0, -1.2, 1.2, -1, 1, 0])
    tau = 10.0 * np.sin(t[:, None] * speeds)
    yield "UR10", replay(model, t, q, torques=Torques(t, tau))
    yield "UR10, all", everything(model, t, q, q + 0.2, tau)
    model = RobotModel.from_urdf(example_urdf("go2.urdf"), free_flyer=True)
    phase = 9.0 * t[:, None] + np.repeat([0.0, np.pi, np.pi, 0.0], 3)
    legs = np.tile([0.0, 0.8, -1.6], 4) + np.tile([0.05, 0.25, 0.3], 4) * np.sin(phase)
    base = np.zeros((len(t), 7))
    base[:, 0], base[:, 2], base[:, 6] = 0.1 * t, 0.33, 1.0
    q = np.hstack([base, legs])
    yield "Go2, all", everything(model, t, q, np.hstack([base, legs + 0.05]), 10.0 * np.sin(phase))


def everything(model, t, q, ghost, tau):
    """Return a page with prediction, ellipsoids and ghost."""
    pi = model.standard_parameters()
    torques = Torques(t, tau, {"fit": 0.9 * tau})
    ghosts = {"second": (t, ghost)}
    return replay(model, t, q, torques=torques, masses={"URDF": pi, "fit": pi}, ghosts=ghosts)


def processor_time(session):
    """Return the processor time of the browser's processes so far [s]."""
    info = session.send("SystemInfo.getProcessInfo")["processInfo"]
    return sum(process["cpuTime"] for process in info)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="a short log, one second of playback")
    quick = parser.parse_args().quick
    from playwright.sync_api import sync_playwright

    print(f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"{'page':12} {'MB':>5} {'load s':>7} {'frames/s':>9} {'ms/frame':>9} {'paused %':>9}")
    program = next(filter(None, map(shutil.which, NAMES)))
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        session = browser.new_browser_cdp_session()
        for name, shown in pages(6 if quick else 60):
            path = shown.write(Path(folder) / "replay.html")
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            began = time.perf_counter()
            page.goto(path.as_uri())
            loaded = time.perf_counter() - began
            page.wait_for_timeout(500 if quick else 3000)
            first, spent = page.evaluate(FRAMES), processor_time(session)
            page.wait_for_timeout(1000 if quick else 8000)
            last, spent = page.evaluate(FRAMES), processor_time(session) - spent
            frames = last[0] - first[0]
            page.evaluate("replay.pause()")
            page.wait_for_timeout(500 if quick else 2000)
            paused, began = processor_time(session), time.perf_counter()
            page.wait_for_timeout(1000 if quick else 5000)
            paused = (processor_time(session) - paused) / (time.perf_counter() - began)
            print(
                f"{name:12} {path.stat().st_size / 1e6:5.1f} {loaded:7.2f} "
                f"{frames / (last[1] - first[1]):9.1f} {1e3 * spent / frames:9.1f} "
                f"{100 * paused:9.1f}"
            )
            page.close()
        browser.close()


if __name__ == "__main__":
    main()
