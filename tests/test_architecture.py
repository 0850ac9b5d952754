"""The rules of the house that a machine can check."""

import ast
import importlib
import inspect
import json
import pkgutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import robotid

PACKAGE = Path(robotid.__file__).parent
LINES = [
    "",
    "exceptions _text _typing _native_messages",
    "findings versions _files pages",
    "_settings pages kernels",
    "_arguments",
    "robot logs",
    "log_files regressor",
    "constrained estimators simulation urdf_audit variation workers",
    "doctor recordings",
    "fitting",
    "diagnosis",
    "judgement",
    "identification",
    "closed_loop",
    "online export viewer excitation",
    "advice",
    "report",
    "commands paper",
    "cli",
    "__init__ __main__",
    "",
][1:-1]
LINE = {room: number for number, line in enumerate(LINES) for room in line.split()}
PINOCCHIO = {"robot", "regressor", "simulation", "viewer"}
INSIDE_FUNCTIONS = {
    "yourdfpy": {"robot"},
    "meshcat": {"viewer"},
    "trimesh": {"robot"},
    "pandas": {"judgement"},
    "pyarrow": {"log_files"},
    "rosbags": {"log_files"},
    "h5py": {"log_files"},
    "distributed": {"workers"},
    "loky": {"workers"},
    "rich": {"cli"},
    "coal": {"excitation"},
    "matplotlib": {"paper"},
    "clarabel": {"estimators"},
}


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def room(path):
    """Return the room of a file; a file at the top of the package is one of its own."""
    inside = path.relative_to(PACKAGE).parts
    return inside[0] if len(inside) > 1 else path.stem


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
            yield node.module, at_top, typing_only
        at_top &= not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        typing_only |= isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):  # imports are statements
            inside = getattr(node, part, [])  # of a lambda or a conditional expression: no list
            if isinstance(inside, list):
                waiting += [(child, at_top, typing_only) for child in inside]


def test_a_room_imports_only_rooms_of_the_lines_above():
    upwards = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in modules()
        for name, at_top, typing_only in imports(path)
        if name.startswith("robotid.") and not typing_only
        for mine, other in [(room(path), name.split(".")[1])]
        if mine != other and not LINE[other] < LINE[mine]
    ]
    assert not upwards, "\n".join(upwards)


def test_third_parties_stay_in_their_rooms():
    strays = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in modules()
        for name, at_top, typing_only in imports(path)
        for first in [name.split(".")[0]]
        if (first == "pinocchio" and room(path) not in PINOCCHIO)
        or (first == "numba" and path.name not in ("lanes.py", "vector_lanes.py"))
        or (name.endswith("lanes") and at_top and not (typing_only or path.stem.endswith("lanes")))
        or (first in INSIDE_FUNCTIONS and room(path) not in INSIDE_FUNCTIONS[first])
        or (first in INSIDE_FUNCTIONS and at_top and not typing_only)
    ]
    assert not strays, "\n".join(strays)


def test_estimators_load_no_physics_engine():
    code = "import robotid.estimators, sys; print('pinocchio' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"


def test_importing_the_package_is_light():
    heavy = ["matplotlib", "meshcat", "cvxpy", "yourdfpy", "pyarrow", "clarabel", "rosbags", "h5py"]
    heavy += ["rich", "distributed", "loky"]
    heavy += ["trimesh"]
    found = f"[m for m in {heavy} if m in sys.modules]"
    code = f"from robotid import *\nimport sys, json\nprint(json.dumps({found}))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(run.stdout) == []


def test_logs_and_results_are_handled_without_the_simulator():
    code = (
        "import sys, robotid.commands.logs, robotid.export.entries, robotid.recordings.survey\n"
        "slow = ('robotid.closed_loop.fit', 'robotid.simulation.loops', 'scipy.interpolate')\n"
        "print([m for m in slow if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_help_needs_neither_numpy_nor_pinocchio():
    code = (
        "import sys\nfrom robotid.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print([m for m in ('numpy', 'pinocchio', 'scipy') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip().endswith("[]")


def test_the_package_shows_its_public_api_and_nothing_else():
    import robotid.logs.data  # a room that was loaded stays out of sight

    assert dir(robotid) == [
        "BaseColumns", "BaseMotion", "Contact", "Coupling", "EstimatorSettings", "Identification",
        "Log", "LogSource", "LogUnits", "Loop",
        "OnlineIdentifier", "RobotIdError", "RobotModel", "SignalSettings", "Trajectory",
        "__version__", "check_logs", "identify", "identify_payload", "inspect_urdf", "load_result",
        "preview", "read_job", "read_log", "replay", "run_job", "save_result",
        "write_log", "write_mjcf", "write_ranges", "write_report", "write_sdf",
        "write_urdf",
    ]  # fmt: skip
    with pytest.raises(AttributeError, match="has no attribute 'OLS'"):
        _ = robotid.OLS


def all_modules():
    names = [m.name for m in pkgutil.walk_packages([str(PACKAGE)], "robotid.")]
    return [importlib.import_module(name) for name in names if not name.endswith("__main__")]


@pytest.mark.parametrize("module", all_modules(), ids=lambda m: m.__name__)
def test_all_names_what_exists_and_no_more_than_25(module):
    assert module.__doc__, "a module says what it is for"
    names = module.__all__
    assert len(names) <= 25
    assert len(set(names)) == len(names)
    for name in names:
        assert hasattr(module, name), f"{module.__name__}.__all__ names {name}"


def public_functions():
    """Yield (name, function, its documentation); an override inherits that of what it overrides."""
    for module in all_modules():
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isfunction(thing) and thing.__module__ == module.__name__:
                yield f"{module.__name__}.{name}", thing, inspect.getdoc(thing)
            if inspect.isclass(thing) and thing.__module__ == module.__name__:
                for method_name, method in vars(thing).items():
                    function = getattr(method, "__func__", method)
                    if inspect.isfunction(function) and not method_name.startswith("_"):
                        text = inspect.getdoc(getattr(thing, method_name))
                        yield f"{module.__name__}.{name}.{method_name}", function, text


def test_every_public_argument_is_documented():
    undocumented = []
    for name, function, text in public_functions():
        arguments = [a for a in inspect.signature(function).parameters if a not in ("self", "cls")]
        if not text or (arguments and "Args:" not in text):
            undocumented.append(name)
            continue
        documented = text.partition("Args:")[2]
        undocumented += [f"{name}: {a}" for a in arguments if f"{a}:" not in documented]
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
