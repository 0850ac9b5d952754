"""Check the built documentation: public names, links, fonts. Argument: its folder."""

import re
import sys
from pathlib import Path

import robotid

site = Path(sys.argv[1])
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
if "fonts." in (site / "index.html").read_text():
    sys.exit("index.html loads fonts from a network, wanted a site that is read without one")
print(f"site: {len(shown)} names, {len(list(site.rglob('*.html')))} pages")
