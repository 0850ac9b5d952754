"""The rules of the house that a machine can check."""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import robotid

PACKAGE = Path(robotid.__file__).parent
#: a package imports those before it, and so do sub-packages; "." are the files of the package
PACKAGES = {
    "base": ["."],
    "robot": ["."],
    "data": [".", "files"],
    "dynamics": ["kernels", ".", "simulation"],
    "estimation": [".", "estimators", "variation", "fitting"],
    "diagnosis": [".", "urdf", "logs", "residual", "verdict"],
    "identification": [".", "closed_loop"],
    "design": ["."],
    "output": ["pages", "files", "viewer", "report"],
    "paper": ["."],
    "cli": ["."],
}
PLACES = [(package, part) for package, parts in PACKAGES.items() for part in parts]
PINOCCHIO = {"robot", "dynamics", "output/viewer"}
INSIDE_FUNCTIONS = {
    "yourdfpy": {"robot"}, "meshcat": {"output/viewer"}, "trimesh": {"robot", "output/viewer"},
    "pandas": {"identification"}, "pyarrow": {"data/files"}, "rosbags": {"data/files"},
    "h5py": {"data/files"}, "distributed": {"estimation"}, "loky": {"estimation"}, "rich": {"cli"},
    "coal": {"design"}, "matplotlib": set(),
}  # fmt: skip


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def place(path):
    """Return the package and the sub-package of a file."""
    package, *inside = path.relative_to(PACKAGE).parts
    return package, inside[0] if len(inside) > 1 and inside[0] in PACKAGES[package] else "."


def room(path):
    """Return the place of a file as text, "output/viewer"."""
    return "/".join(place(path)).removesuffix("/.")


def module_file(name):
    """Return the file of a module of robotid, named with its dots."""
    path = PACKAGE.parent.joinpath(*name.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def parsed(path):
    return ast.parse(path.read_text())


@cache
def imports(path):
    """Return (module, whether at the top level, whether only for type checkers) of each import."""
    return list(_imports(parsed(path)))


def _imports(tree):
    waiting = [(tree, True, False)]
    while waiting:
        node, at_top, typing_only = waiting.pop()
        if isinstance(node, ast.Import):
            yield from ((alias.name, at_top, typing_only) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            files = [name for name in inner if module_file(name).is_file()]
            yield from ((name, at_top, typing_only) for name in files or [node.module])
        at_top &= not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        typing_only |= isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):  # imports are statements
            inside = getattr(node, part, [])  # of a lambda or a conditional expression: no list
            if isinstance(inside, list):
                waiting += [(child, at_top, typing_only) for child in inside]


def arrows():
    """Yield (file, imported file) of every import inside the package, for type checkers too."""
    for path in modules():
        if path.parent != PACKAGE:
            for name, *_ in imports(path):
                if name.startswith("robotid."):
                    yield path, module_file(name)


def test_every_file_is_in_one_of_the_eleven_packages():
    assert {path.name for path in PACKAGE.iterdir()} - {"__pycache__"} == {
        *PACKAGES, "__init__.py", "__main__.py", "py.typed",
    }  # fmt: skip


def test_a_package_imports_only_those_before_it():
    upwards = [
        f"{path.relative_to(PACKAGE)} imports {other.relative_to(PACKAGE)}"
        for path, other in arrows()
        if PLACES.index(place(other)) > PLACES.index(place(path))
    ]
    assert not upwards, "\n".join(upwards)


def test_no_files_import_each_other_in_a_circle():
    graph = {path: set() for path in modules()}
    for path, other in arrows():
        graph[path].add(other)
    assert set(TopologicalSorter(graph).static_order()) == set(graph)  # a CycleError names a circle


def test_third_parties_stay_in_their_rooms():
    strays = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in modules()
        for name, at_top, typing_only in imports(path)
        for first in [name.split(".")[0]]
        if (first == "pinocchio" and not PINOCCHIO & {room(path), place(path)[0]})
        or (first == "numba" and path.name != "lanes.py")
        or (name.endswith("lanes") and at_top and not (typing_only or path.stem.endswith("lanes")))
        or (first in INSIDE_FUNCTIONS and room(path) not in INSIDE_FUNCTIONS[first])
        or (first in INSIDE_FUNCTIONS and at_top and not typing_only)
    ]
    assert not strays, "\n".join(strays)


def test_help_and_imports_load_no_more_than_they_need():
    """Each step in the process of those before it, from the lightest."""
    slow = "robotid.identification.closed_loop.stages robotid.dynamics.simulation.loops"
    heavy = "matplotlib meshcat cvxpy yourdfpy pyarrow clarabel rosbags h5py rich distributed loky"
    steps = {
        "from robotid.cli import main\nwith suppress(SystemExit):\n    main(['--help'])": (
            "numpy pinocchio scipy"
        ),
        "import robotid.estimation.estimators": "pinocchio",
        "import robotid.cli.logs, robotid.output.files.entries\n"
        "import robotid.estimation.fitting.recorded": f"{slow} scipy.interpolate",
        "from robotid import *": f"{heavy} trimesh scipy.interpolate scipy.optimize",
    }
    code = "import sys\nfrom contextlib import suppress\n" + "\n".join(
        f"{step}\nprint([m for m in {names.split()} if m in sys.modules], file=sys.stderr)"
        for step, names in steps.items()
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stderr.splitlines() == ["[]"] * len(steps)


def test_the_package_shows_its_public_api_and_nothing_else():
    import robotid.data.log  # a room that was loaded stays out of sight

    assert dir(robotid) == sorted([
        "identify", "doctor", "inspect", "excite", "preview", "simulate", "payload", "validate",
        "compare", "replay", "export", "load_result", "save_result", "read_log", "write_log",
        "RobotModel", "Log", "Trajectory", "Identification", "OnlineIdentifier",
        "EstimatorSettings", "SignalSettings", "RobotIdError", "__version__",
    ])  # fmt: skip
    assert len(robotid.__all__) <= 24
    with pytest.raises(AttributeError, match="has no attribute 'OLS'"):
        _ = robotid.OLS


def test_every_module_says_what_it_is_for():
    names = [m.name for m in pkgutil.walk_packages([str(PACKAGE)], "robotid.")]
    modules = [importlib.import_module(name) for name in names if not name.endswith("__main__")]
    assert not [module.__name__ for module in modules if not module.__doc__]


def public_names():
    """Return the names of ``robotid.__all__`` and those the reference of the docs explains."""
    pages = (PACKAGE.parent / "docs" / "reference").rglob("*.md")
    explained = re.findall(r"^::: (\S+)$", "\n".join(map(Path.read_text, pages)), re.MULTILINE)
    return {*explained, *(f"robotid.{name}" for name in robotid.__all__)} - {
        "robotid.__version__", "robotid.base.exceptions",
    }  # fmt: skip


def public_functions():
    """Yield (name, function, its documentation); an override inherits that of what it overrides."""
    for name in sorted(public_names()):
        module, _, last = name.rpartition(".")
        thing = getattr(importlib.import_module(module), last)
        if inspect.isfunction(thing):
            yield name, thing, inspect.getdoc(thing)
        else:
            for method_name, method in vars(thing).items():
                function = getattr(method, "__func__", method)
                is_public = inspect.isfunction(function) and not method_name.startswith("_")
                if is_public and function.__qualname__.startswith(thing.__name__):
                    text = inspect.getdoc(getattr(thing, method_name))
                    yield f"{name}.{method_name}", function, text


def test_every_public_argument_is_documented():
    """Those of ``robotid`` one by one; what only the reference explains needs a text."""
    undocumented, count = [], 0
    for name, function, text in public_functions():
        count += 1
        arguments = [a for a in inspect.signature(function).parameters if a not in ("self", "cls")]
        if name.split(".")[1] not in robotid.__all__:
            arguments = []
        if not text or (arguments and "Args:" not in text):
            undocumented.append(name)
            continue
        documented = text.partition("Args:")[2]
        undocumented += [f"{name}: {a}" for a in arguments if f"{a}:" not in documented]
    assert count > 60
    assert not undocumented, "\n".join(undocumented)


def test_functions_stay_small():
    long = []
    for path in modules():
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[1:] if ast.get_docstring(node) else node.body
                lines = node.end_lineno - body[0].lineno + 1 if body else 0
                if lines > 60:
                    long.append(f"{path.relative_to(PACKAGE)} {node.name} has {lines} lines")
    assert not long, "\n".join(long)


def test_version_is_stated_once():
    assert 'dynamic = ["version"]' in (PACKAGE.parent / "pyproject.toml").read_text()
    assert robotid.__version__.count(".") == 2
