"""Write the README's pictures, report.png and replay.png, from a fresh ``robotid demo``.

    python benchmarks/write_pictures.py

It needs the extra [dev] and a Chromium.
"""

import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
HERE = ROOT / "docs" / "pictures"
sys.path.insert(0, str(ROOT / "tests"))
from helpers.browsing import launch, visit

from robotid.cli.demo import run_demo


def main():
    with tempfile.TemporaryDirectory() as name, contextmanager(launch)() as browser:
        folder = Path(name) / "robotid-demo"  # pages write absolute folders as "…"
        run_demo(folder)
        with visit(browser, folder / "report.html", size=(1280, 640)) as seen:
            seen.page.screenshot(path=HERE / "report.png")
        with visit(browser, folder / "replay.html", size=(1200, 640)) as seen:
            seen.page.evaluate("replay.pause(); replay.seek(6); replay.pick(2)")
            seen.page.wait_for_timeout(1000)
            seen.page.screenshot(path=HERE / "replay.png")
    for picture in HERE.glob("*.png"):
        Image.open(picture).convert("RGB").quantize(192).save(picture, optimize=True)


if __name__ == "__main__":
    main()
