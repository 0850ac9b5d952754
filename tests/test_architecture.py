"""The rules of the house that a machine can check."""

import ast
import importlib
import inspect
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import robotid

PACKAGE = Path(robotid.__file__).parent
FLOORS = {
    0: "exceptions _typing __init__",
    1: "parameters data problem program proximity kinematics metrics xml_splice examples "
    "innovations online_settings job_keys lanes lapack log_source console signal_settings "
    "progress work_flags versions report_page replay_page surprises reversals determination",
    2: "factors units model smoothing live_signals base_parameters verdict planar_2r procedure "
    "time_stamps compiled columns array_tables csv_files parquet_files bags summaries meshes "
    "ellipsoids",
    3: "uncertainty array_files estimators plant lumping prior rows log_checks signals pieces "
    "scene doubts",
    4: "standard_errors regressor excitation tables channel_checks link_geometry "
    "constraint_settings task checkpoint prediction inertial_audit",
    5: "bands link_audit validation sidecar estimator_settings simulation dynamics log_files "
    "probe mass_matrix reduction",
    6: "recordings closed_loop conversion explanations load_checks cluster residuals torque_delay",
    7: "robust urdf job visualization report_plots paper_simulation paper_trajectories "
    "model_checks motion_checks long_logs work_plan",
    8: "locked_joints identification diagnosis_plots",
    9: "information online result inspection paper_errata consistency_findings long_recordings "
    "long_jobs report_consistency paper_replay",
    10: "comparison report_diagnosis doctor report_tables paper_plots paper_page tracking "
    "checkpoint_inputs replay_job",
    11: "live comparison_page report paper",
    12: "workflow revalidation",
    13: "demo flags",
    14: "cli",
    15: "__main__",
}
FLOOR = {name: floor for floor, names in FLOORS.items() for name in names.split()}
PINOCCHIO = {
    "model", "regressor", "plant", "simulation", "visualization", "lumping", "prior", "rows",
    "compiled", "link_geometry", "mass_matrix", "prediction", "scene",
}  # fmt: skip
NUMBA = {"lanes"}  # at its top; no module imports lanes at its own

INSIDE_FUNCTIONS = {
    "yourdfpy": {"urdf"},
    "meshcat": {"replay_page"},
    "trimesh": {"link_geometry", "meshes"},
    "pyarrow": {"parquet_files"},
    "rosbags": {"bags"},
    "distributed": {"cluster"},
    "rich": {"progress"},
    "h5py": {"array_files"},
    "matplotlib": {"report", "report_plots", "paper", "paper_plots", "diagnosis_plots"},
    "clarabel": {"estimators"},
    "scs": {"estimators"},
}
# modules that robotid.estimators may use among themselves, from the interface up
ESTIMATOR_FLOORS = {
    name: floor
    for floor, names in enumerate(
        (
            "estimator cones priors",
            "least_squares recursive solvers constraints",
            "programme rls kalman descent total_least_squares",
            "physical",
            "prx gradient weighting log_cholesky",
            "__init__",
        )
    )
    for name in names.split()
}


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def room(path):
    """Return the module that has a floor: a file, or the folder it is in."""
    inside = path.relative_to(PACKAGE).parts
    return inside[0] if len(inside) > 1 else path.stem


def imports(path):
    """Yield (module, whether at the top level, whether only for type checkers)."""
    tree = ast.parse(path.read_text())
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module]
        else:
            continue
        above, at_top, typing_only = parents[node], True, False
        while above is not tree:
            at_top &= not isinstance(above, ast.FunctionDef | ast.AsyncFunctionDef)
            typing_only |= isinstance(above, ast.If) and "TYPE_CHECKING" in ast.dump(above.test)
            above = parents[above]
        for name in names:
            yield name, at_top, typing_only


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_module_imports_only_from_lower_floors(path):
    for name, _, typing_only in imports(path):
        parts = name.split(".")
        if parts[0] != "robotid" or typing_only or len(parts) == 1:
            continue
        if parts[1] == room(path) == "estimators":
            assert ESTIMATOR_FLOORS[parts[2]] < ESTIMATOR_FLOORS[path.stem], name
            continue
        assert FLOOR[parts[1]] < FLOOR[room(path)], f"{path.name} imports {name}"


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_third_parties_stay_in_their_rooms(path):
    for name, at_top, typing_only in imports(path):
        first = name.split(".")[0]
        if first == "pinocchio":
            assert room(path) in PINOCCHIO, f"{path.name} imports {name}"
        if first == "numba":
            assert room(path) in NUMBA, f"{path.name} imports {name}"
        if name.removeprefix("robotid.") in NUMBA:
            assert not at_top, f"{path.name} imports {name} at its top"
        if first in INSIDE_FUNCTIONS:
            assert room(path) in INSIDE_FUNCTIONS[first], f"{path.name} imports {name}"
            assert not at_top or typing_only, f"{path.name} imports {name} at its top"


def test_no_estimator_knows_the_physics_engine():
    for path in (PACKAGE / "estimators").glob("*.py"):
        assert all("pinocchio" not in name for name, _, _ in imports(path)), path.name


@pytest.mark.parametrize("statement", ["import robotid", "from robotid import *"])
def test_importing_the_package_is_light(statement):
    heavy = ["matplotlib", "meshcat", "cvxpy", "yourdfpy", "pyarrow", "clarabel", "rosbags", "h5py"]
    heavy += ["rich", "distributed"]
    heavy += ["scs", "trimesh"]
    heavy += ["trimesh"]
    found = f"[m for m in {heavy} if m in sys.modules]"
    code = f"{statement}\nimport sys, json\nprint(json.dumps({found}))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(run.stdout) == []


def test_help_needs_neither_numpy_nor_pinocchio():
    code = (
        "import sys\nfrom robotid.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print([m for m in ('numpy', 'pinocchio', 'scipy') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip().endswith("[]")


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
    for module in all_modules():
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isfunction(thing) and thing.__module__ == module.__name__:
                yield f"{module.__name__}.{name}", thing
            if inspect.isclass(thing) and thing.__module__ == module.__name__:
                for method_name, method in vars(thing).items():
                    function = getattr(method, "__func__", method)
                    if inspect.isfunction(function) and not method_name.startswith("_"):
                        yield f"{module.__name__}.{name}.{method_name}", function


@pytest.mark.parametrize(("name", "function"), list(public_functions()), ids=lambda x: str(x)[:70])
def test_every_public_argument_is_documented(name, function):
    text = inspect.getdoc(function) or ""
    assert text, f"{name} has no docstring"
    arguments = [a for a in inspect.signature(function).parameters if a not in ("self", "cls")]
    if not arguments or name.endswith("Motion.evaluate"):
        return
    assert "Args:" in text, f"{name} documents no argument"
    documented = text.split("Args:")[1]
    for argument in arguments:
        assert f"{argument}:" in documented, f"{name} does not document {argument}"


def test_files_and_functions_stay_small():
    for path in modules():
        lines = path.read_text().count("\n")
        assert lines <= 400, f"{path.name} has {lines} lines"


def test_version_is_stated_once():
    assert 'dynamic = ["version"]' in (PACKAGE.parent / "pyproject.toml").read_text()
    assert robotid.__version__.count(".") == 2
