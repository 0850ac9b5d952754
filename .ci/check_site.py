"""Check the built documentation: public names, links, network, search. Argument: its folder."""

import re
import sys
from contextlib import contextmanager
from pathlib import Path

import robotid

sys.path.append("tests")
from helpers.browsing import launch

site = Path(sys.argv[1]).resolve()
pages = [page.read_text() for page in (site / "reference/api").glob("*.html")]
shown = [name for page in pages for name in re.findall(r'id="robotid\.(\w+)"', page)]
wanted = set(robotid.__all__) - {"__version__"}
if missing := sorted(wanted - set(shown)):
    sys.exit(f"names that the site lacks: {', '.join(missing)}; add them to docs/reference/api")
if twice := sorted({name for name in shown if shown.count(name) > 1}):
    sys.exit(f"names that the site documents twice: {', '.join(twice)}; see docs/reference/api")
if "plot_friction" not in (site / "tutorials/first_steps.html").read_text():
    sys.exit("tutorials/first_steps.html does not show the notebook")
if 'href="first_steps.html"' not in (site / "tutorials/first_arm.html").read_text():
    sys.exit("tutorials/first_arm.html links the notebook's file, wanted its page")
if loaded := re.findall('(?:src|stylesheet" href)="(http[^"]+)', (site / "index.html").read_text()):
    sys.exit(f"index.html loads {loaded[0]}, expected a site that needs no network")
with contextmanager(launch)() as browser:
    page = browser.new_page()
    page.goto((site / "index.html").as_uri())
    page.click("input.md-search__input")
    page.keyboard.type("payload")
    page.wait_for_selector(".md-search-result__item a[href*='payload']")
print(f"site: {len(shown)} names, {len(list(site.rglob('*.html')))} pages")
