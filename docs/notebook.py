"""The notebook of first steps as a page of the site, with its outputs where they were made.

    python docs/notebook.py

runs its cells and writes their outputs to build/notebook, as the build of the site does if there
are none.
"""

import ast
import contextlib
import io
import json
import os
import tempfile
from pathlib import Path

NOTEBOOK = Path(__file__).parent / "tutorials" / "first_steps.ipynb"
OUTPUTS = Path(__file__).parents[1] / "build" / "notebook"
_PAGE = """<!doctype html><meta charset="utf-8"><style>
:root {{ color-scheme: light dark; font: 14px system-ui, sans-serif }}
body {{ margin: 0 }} body > :not(iframe) {{ margin-left: 8px }} iframe {{ width: 100%; border: 0 }}
table {{ border-collapse: collapse }} td, th {{ padding: 2px 8px; text-align: right }}
</style>{}"""


def cells():
    """Return the cells of the notebook: id, whether it is code, and its text."""
    notebook = json.loads(NOTEBOOK.read_text())["cells"]
    return [(c["id"], c["cell_type"] == "code", "".join(c["source"])) for c in notebook]


def page():
    """Return the page: text as it is, code, and below it what it printed and what its value is."""
    parts = []
    for name, is_code, text in cells():
        parts.append(f"```python\n{text}\n```" if is_code else text)
        if (OUTPUTS / f"{name}.txt").exists():
            parts.append(f"```text\n{(OUTPUTS / f'{name}.txt').read_text().rstrip()}\n```")
        if (OUTPUTS / f"{name}.html").exists():
            parts.append(
                f'<iframe src="first_steps/{name}.html" title="Output of {name}" loading="lazy" '
                f'style="width:100%;height:24rem;border:1px solid #8884"></iframe>'
            )
    link = "Download [the notebook](first_steps.ipynb) to run it yourself."
    return "\n\n".join([parts[0], link, *parts[1:]]) + "\n"


def run():
    """Run the cells and write their outputs: text that they print, and values as HTML or text."""
    OUTPUTS.mkdir(parents=True, exist_ok=True)
    for old in OUTPUTS.iterdir():
        old.unlink()
    namespace = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name, is_code, text in cells():
            if is_code:
                printed, value = executed(text, namespace)
                if hasattr(value, "_repr_html_"):
                    (OUTPUTS / f"{name}.html").write_text(_PAGE.format(value._repr_html_()))
                elif value is not None:
                    printed += repr(value)
                if printed:
                    (OUTPUTS / f"{name}.txt").write_text(printed)


def executed(text, namespace):
    """Return what a cell prints, and the value of its last line."""
    *steps, last = ast.parse(text).body
    if not isinstance(last, ast.Expr):
        steps, last = [*steps, last], None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(ast.Module(steps, []), str(NOTEBOOK), "exec"), namespace)
        value = last and eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), namespace)
    return printed.getvalue(), value


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    run()
