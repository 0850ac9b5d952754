"""The browser of the tests, the system's Chromium, driven by Playwright: without it they skip."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

IN_CI = os.environ.get("CI") == "true"
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # no GPU needed
#: The processor puts pages together and emulates a GPU for 3-D views alone, which says so.
OF_THE_EMULATION = (
    "GL Driver Message (OpenGL, Performance, GL_CLOSE_PATH_NV, High): GPU stall due to ReadPixels"
)
#: A page that itself reads pixels gives this message, too: it gets one of ours.
READS_PIXELS = """
for (const { prototype } of [WebGLRenderingContext, WebGL2RenderingContext]) {
  const read = prototype.readPixels;
  prototype.readPixels = function (...args) {
    console.warn("the page reads pixels");
    return read.apply(this, args);
  };
}"""
NO_BROWSER = f"no browser: none of {', '.join(NAMES)} is on PATH; apt-get install chromium"


@dataclass
class Visit:
    """A page in the browser, and what went wrong on it."""

    page: Any
    errors: list[str] = field(default_factory=list)  # and warnings, uncaught exceptions
    requests: list[str] = field(default_factory=list)  # of addresses that leave the machine


def until(seen: Visit, expression: str, timeout: float = 20.0) -> None:
    """Wait until a page says yes. Playwright's wait_for_function needs eval, which pages forbid."""
    end = time.monotonic() + timeout
    while not seen.page.evaluate(expression):
        assert time.monotonic() < end, f"{expression} is not true after {timeout:g} s"
        seen.page.wait_for_timeout(50)


def launch() -> Iterator[Any]:
    """Yield a browser: what the fixture ``browser`` gives."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        assert not IN_CI, f"CI must not skip the browser tests: {NO_BROWSER}"
        pytest.skip(NO_BROWSER)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def visit(
    browser: Any, target: str | Path, *, size: tuple[int, int] = (1280, 800), **options: Any
) -> Iterator[Visit]:
    """Open a file or an address in a window [px]; options are those of Playwright's new_context."""
    # A page that is lost while it loads, as on a busy machine, is opened once more.
    from playwright.sync_api import Error

    address = Path(target).resolve().as_uri() if isinstance(target, Path) else target
    options["viewport"] = {"width": size[0], "height": size[1]}
    for attempt in range(2):
        context = browser.new_context(**options)
        try:
            seen = _opened(context, address)
            break
        except Error:
            context.close()
            if attempt:
                raise
    try:
        yield seen
    finally:
        context.close()


def _opened(context: Any, address: str) -> Visit:
    """Open an address and note what goes wrong."""
    page = context.new_page()
    page.add_init_script(READS_PIXELS)
    seen = Visit(page)
    page.on("pageerror", lambda error: seen.errors.append(str(error)))

    def hear(message: Any) -> None:
        if message.type in ("error", "warning") and OF_THE_EMULATION not in message.text:
            seen.errors.append(message.text)

    def note(request: Any) -> None:
        if request.url != address and not request.url.startswith(("data:", "blob:")):
            seen.requests.append(request.url)

    page.on("console", hear)
    page.on("request", note)
    page.goto(address)
    return seen
