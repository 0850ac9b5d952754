"""Hostile inputs: a traceback is a failure. ``benchmarks/bench_fuzz.py`` tries thousands."""

import contextlib
import copy
import io
import json
import tempfile
import tomllib
import warnings
import zipfile
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import scipy.io
from hypothesis import strategies as st

from helpers.hostile_urdfs import ANY, any_of, run_urdf, urdf_inputs
from helpers.paths import URDF as URDF_FOLDER
from helpers.recorders import messages_of, write_mcap, write_states
from helpers.synthetic import exact_log, truth
from robotid.cli import main
from robotid.cli.job import Job
from robotid.data.files.read import write_log
from robotid.estimation.fitting.estimator_settings import ESTIMATORS
from robotid.robot.model import RobotModel

URDF = str(URDF_FOLDER / "planar_2r.urdf")
JOINTS = ("joint_1", "joint_2")
COLUMNS = ["time", *(f"{kind}_{joint}" for kind in ("q", "dq", "tau") for joint in JOINTS)]

# --- what is done with an input ------------------------------------------------------------------


def obey(*words, out=None):
    """Run a command line: it ends in its own words; out, file or folder, is whole or as before."""
    before = files_in(out)
    shown, error = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(shown),
        contextlib.redirect_stderr(error),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:  # of argparse
            code = end.code
    assert code in (0, 1, 2), f"exit code {code}"
    assert "Traceback" not in error.getvalue()
    assert len(error.getvalue()) < 20_000, "an error of pages"
    if code != 0:
        assert files_in(out) == before, f"half-written: {files_in(out)}"
    hidden = [name for name in files_in(out and Path(out).parent) if "/." in name]
    assert not hidden, f"left behind: {hidden}"
    return code


def files_in(place):
    place = Path(place or "nowhere")
    found = place.rglob("*") if place.is_dir() else [place]
    return sorted(str(path) for path in found if path.is_file())


def read_log_file(write, suffix, example, folder):
    """Examine and convert what ``write`` makes of an example."""
    path = folder / f"in{suffix}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write(example, path)
    except Exception:  # that library cannot write it: then nobody has such a file
        return
    obey("doctor", URDF, path)
    obey("convert", path, folder / "out.csv", out=folder / "out.csv")


def identify_from(example, folder):
    path, out = folder / "in.csv", folder / "out"
    write_csv(example, path)
    words = ("identify", URDF, path, "--validate", path, "--out", out)
    result = out / "result.json"
    if obey(*words) == 1 and result.exists():  # judged to be wrong: said, and no URDF
        said = json.loads(result.read_text(encoding="utf-8"))
        assert said["verdict"]["log_errors"], "refused without a word"
        assert "urdf" not in said["outputs"]
        assert {Path(name).name for name in files_in(out)} == {"report.html", "result.json"}
    elif not result.exists():
        assert not files_in(out), f"half-written: {files_in(out)}"


# --- bytes that were spoilt ----------------------------------------------------------------------


@cache
def good_log(samples=60):
    model = RobotModel.from_urdf(URDF)
    rng = np.random.default_rng(0)
    return exact_log(model, truth(model), rng, samples=samples, rate=50.0, noise=0.1)


@cache
def good_file(name):
    """Return the bytes of a valid file of a kind."""
    log = good_log()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        joints = [joint.encode() for joint in JOINTS]
        table = {"time": log.t, "q": log.q, "tau": log.tau, "joints": joints}
        if name == "log.mcap":
            write_mcap(path, messages_of(log))
        elif name == "log.bag":
            write_states(path, {"/joint_states": messages_of(log)})
        elif name == "log.db3":
            write_states(path.with_suffix(""), {"/joint_states": messages_of(log)})
            path = next(path.with_suffix("").glob("*.db3"))
        elif name.startswith("plain"):
            READERS[path.suffix](table, path)
        else:
            write_log(log, path)
        return path.read_bytes()


SPECIAL = [
    b"\0", b"\xff", b"\n", b",", b'"', b"nan", b"1e308", b"\0\0\0\0", b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f", b"\x80", b"-", b"'", b"(", b"9" * 30,
]  # fmt: skip


@st.composite
def spoilt(draw, name):
    """Bytes of a valid file after a few edits."""
    content = bytearray(good_file(name))
    new = st.sampled_from(SPECIAL) | st.binary(min_size=1, max_size=8)
    for _ in range(draw(st.integers(1, 4))):
        at, length = draw(st.integers(0, len(content))), draw(st.integers(0, 64))
        # headers and indices stand at the ends of a file
        at = draw(st.sampled_from([at, at % 256, max(len(content) - at % 256, 0)]))
        match draw(any_of("overwrite overwrite insert delete cut repeat")):
            case "overwrite":
                part = draw(new)
                content[at : at + len(part)] = part
            case "insert":
                content[at:at] = draw(new)
            case "delete":
                del content[at : at + length]
            case "cut":
                del content[at:]
            case "repeat":
                content[at:at] = content[at : at + length]
    return bytes(content)


# --- tables of hostile values --------------------------------------------------------------------

NUMBERS = [
    0.0, -0.0, 1.0, -1.0, 1e-320, 1e-308, 1e-30, 1e30, 1e150, 1e300, 1e308, -1e308, np.nan,
    np.inf, -np.inf, 1e6, 1.7e9, 1.7e18, 2**53, np.pi, 360.0,
]  # fmt: skip
numbers = st.sampled_from(NUMBERS) | st.floats()


@st.composite
def columns(draw, rows=None, numbers=numbers):
    """A table of columns, most of it good, some of it hostile."""
    if rows is None:
        rows = draw(st.sampled_from([0, 1, 2, 2, 3, 5, 6, 40]))
    log = good_log(max(rows, 60))
    good = np.column_stack([log.t, log.q, log.v, log.tau])[:rows]
    table = {name: good[:, k].copy() for k, name in enumerate(COLUMNS)}
    for _ in range(draw(st.integers(0, 4))):
        name = draw(st.sampled_from(sorted(table)))
        action = draw(any_of("one all scale jump shift drop rename"))
        if action == "drop" and len(table) > 1:
            del table[name]
        elif action == "rename":
            table[draw(names)] = table.pop(name)
        elif rows:
            _spoil(table[name], action, draw(st.integers(0, rows - 1)), draw(numbers))
    return table


def _spoil(values, action, row, number):
    with np.errstate(all="ignore"):
        match action:
            case "one":
                values[row] = number
            case "all":
                values[:] = number
            case "scale":
                values *= number
            case "jump":
                values[row:] += number
            case "shift":
                values += number


#: Numbers that a reader lets through.
MILD = [0.0, -1.0, 1e-300, 1e-30, 1e-9, 1e-3, 0.1, 0.5, 2.0, np.pi, 10.0, 1e3, 1e6, 1e9, 1e20, 1e29]
names = st.sampled_from([
    "", " ", "t", "time", "q_", "_", "q_joint_1", "tau_joint_3", "nan", "x" * 300, "time,t", '"',
    "é", "\U0001f916", "a/b", "#x", "current_joint_1",
])  # fmt: skip


def write_csv(table, path):
    rows = [",".join(repr(float(x)) for x in row) for row in zip(*table.values(), strict=True)]
    path.write_text("\n".join([",".join(table), *rows]), encoding="utf-8")


def write_hdf5(table, path):
    with h5py.File(path, "w") as file:
        for name, values in table.items():
            file.create_dataset(name, data=values)


READERS = {
    ".csv": write_csv,
    ".npz": lambda table, path: np.savez(path, **table),
    ".mat": lambda table, path: scipy.io.savemat(path, table),
    ".h5": write_hdf5,
    ".parquet": lambda table, path: pyarrow.parquet.write_table(pyarrow.table(table), path),
}

# --- containers that claim what they do not hold -------------------------------------------------

#: What stands where an array of numbers should.
ODD = [
    np.array(["a", "b"]), np.array(b"\xff\xfe"), np.array([b"\xff", b"joint_1"]), np.array(1.0),
    np.zeros((2, 3, 4)), np.zeros((0, 3)), np.zeros(0), np.array([1j, 2j]), np.array([True, False]),
    np.zeros(3, dtype=[("a", "f8"), ("b", "U3")]), np.array([0, 2**63], dtype=np.uint64),
    np.array(["2020-01-01"], dtype="datetime64[D]"), np.full((60, 5), 1e308), np.zeros((60, 1)),
    np.array(["joint_1", "joint_2"]), np.array(["joint_1"] * 3), np.arange(60.0).reshape(1, 60),
]  # fmt: skip
odd = st.sampled_from(ODD)
keys = any_of("time t q tau joints joint_names dq a/time a/q #")
sizes = st.sampled_from([0, 1, 2, 60, 10**6, 10**9, 10**12, 2**31 - 1, 2**40, -1])
shapes = st.lists(sizes, max_size=4)
arrays = st.dictionaries(keys, odd, max_size=6)


@st.composite
def headers(draw):
    """Members of a zip whose NumPy headers claim anything."""
    made = {}
    for name in draw(st.lists(keys, min_size=1, max_size=4, unique=True)):
        kind = draw(any_of("<f8 |O <U9 >i2 <M8[s] nonsense <f16 |V0"))
        lacking = {"descr": kind, "shape": tuple(draw(shapes))}
        whole = lacking | {"fortran_order": draw(st.booleans())}
        texts = [repr(whole), repr(lacking), "{" * 200, "__import__('os')", ""]
        text = draw(st.sampled_from(texts))
        version = draw(st.sampled_from([b"\1\0", b"\2\0", b"\3\0", b"\x09\0"]))
        size = len(text).to_bytes(2 if version == b"\1\0" else 4, "little")
        made[name] = b"\x93NUMPY" + version + size + text.encode() + draw(st.binary(max_size=64))
    return made


def write_members(members, path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)


def write_odd_hdf5(content, path):
    """Write arrays, sizes that are only claimed, text of all kinds, and links into nowhere."""
    made, claimed, links = content
    with h5py.File(path, "w") as file:
        for name, values in made.items():
            is_text = values.dtype.kind == "U"
            kind = h5py.string_dtype() if is_text else None
            file.create_dataset(name, data=values.astype(object) if is_text else values, dtype=kind)
        for name, shape in claimed.items():
            if name not in file:
                file.create_dataset(name, tuple(map(abs, shape)), dtype="f8", chunks=True)
        for name, link in links.items():
            if name not in file:
                file[name] = link if link is not None else file["/"]


targets = [None, h5py.SoftLink("/none"), h5py.SoftLink("/a"), h5py.ExternalLink("no.h5", "/x")]
link_names = st.sampled_from(["a", "b", "time", "q"])
links = st.dictionaries(link_names, st.sampled_from(targets), max_size=3)
odd_hdf5 = st.tuples(arrays, st.dictionaries(keys, shapes, max_size=3), links)


def _nested(inner):
    cell_arrays = st.lists(inner, max_size=3).map(lambda items: np.fromiter(items, dtype=object))
    return cell_arrays | st.dictionaries(keys, inner, max_size=3)


cells = st.recursive(odd, _nested)


def write_odd_mat(content, path):
    named = {name.replace("/", "_"): x for name, x in content.items() if name != "#"}
    scipy.io.savemat(path, named)


# --- settings ------------------------------------------------------------------------------------

JOB = f"""
urdf = "{URDF}"
[[identification]]
log = "fit.csv"
"""
plain = st.one_of(
    any_of("x joint_1 a\0b \U0001f916 auto none $X ../x") | st.sampled_from(["", "x" * 3000]),
    st.sampled_from([0, 1, -1, 2, 3, 10**9, 10**40, 2**63, 0.5, 1e-320, 1e308, -1e308, 1e30, 1e6]),
    st.sampled_from([np.nan, np.inf, -np.inf, True, False]),
    st.integers(), st.floats(), st.text(ANY, max_size=8).filter(lambda text: text.isprintable()),
)  # fmt: skip
words = st.sampled_from([*JOINTS, "link_1", "link_2", "torque_scale", "name", "ratios", "x", ""])
values = st.recursive(
    plain,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)


def broken(draw, text, others):
    """Return a text, into one of ten of which another one is inserted."""
    if draw(st.integers(0, 9)):
        return text
    at = draw(st.integers(0, len(text)))
    return text[:at] + draw(st.sampled_from(others)) + text[at:]


rarely = st.integers(0, 9).map(lambda n: n == 0)
#: What the settings of a kind may be, to their ends.
MILD_OF = {
    bool: st.booleans(),
    str: any_of("usual none pd feedforward computed_torque perfect joint motor torque find urdf "
                "one group link_1 link_2"),
    float: st.sampled_from([0, 1e-9, 1e-3, 0.05, 0.5, 1, 1.0, 5.0, 30.0, 1e3, 1e5, 1e9, 1e12]),
    list: st.sampled_from([[0.0, 0.0, 0.1], [1.0, 0.0, 1.0, 0.0, 0.0, 1.0], [1e9] * 6, [JOINTS]]),
}  # fmt: skip
named = st.sampled_from([*JOINTS, *JOINTS, "x", "joint_1.viscous", "link_1.mass"])
MILD_OF[dict] = st.dictionaries(named, MILD_OF[float] | plain, max_size=3)


def keys_of(schema, prefix=()):
    """Yield the path and the kinds of every key of a schema, those of tables, too."""
    for key, kind in schema.items():
        path = (*prefix, key, 0) if isinstance(kind, list) else (*prefix, key)
        table = kind[0] if isinstance(kind, list) else kind
        if isinstance(table, dict):
            yield from keys_of(table, path)
        kinds = (dict,) if isinstance(table, dict) else kind
        yield path, (kinds.outer,) if hasattr(kinds, "outer") else kinds


@st.composite
def settings_of(draw, schema, start="", odd=1):
    """A table of a schema, begun as TOML, with more values, ``odd`` of ten of the wrong kind."""
    table = tomllib.loads(start)
    for path, kinds in draw(st.lists(st.sampled_from(list(keys_of(schema))), max_size=3)):
        mild = st.one_of(*(MILD_OF[float if one is int else one] for one in kinds))
        inside, value = table, draw(values if draw(st.integers(0, 9)) < odd else mild)
        with contextlib.suppress(
            TypeError, IndexError, AttributeError
        ):  # an earlier value took that place
            for key, following in pairwise(path):
                default = [{}] if following == 0 else {}
                inside = inside[key] if key == 0 else inside.setdefault(key, default)
            inside[path[-1]] = value
    return table


@st.composite
def jobs(draw):
    """The text of a job file with some values of any type and size."""
    table = draw(settings_of(Job.schema(), JOB, odd=7))
    if draw(st.booleans()):
        table["estimator"] = {"name": draw(st.sampled_from(sorted(ESTIMATORS)))}
    return broken(draw, toml_file(table), ["[" * 3000, "=", '"', "\0", "1" * 5000])


def toml_file(table):
    return "\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in table.items())


def toml(value):
    """Return a value as TOML has it, in one line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        inside = ", ".join(f"{json.dumps(key)} = {toml(x)}" for key, x in value.items())
        return f"{{ {inside} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, str):
        return json.dumps(value)
    return repr(value)


def run_job(text, log, folder):
    write_log(log, folder / "fit.csv")
    path, out = folder / "job.toml", folder / "out"
    path.write_text(text, encoding="utf-8", errors="replace")
    obey("identify", path, "--out", out, out=out)


def run_job_file(text, folder):
    run_job(text, good_log(200), folder)


flags = any_of(
    "--rate --cutoff --friction --joints --lock --gain --ignore --estimator --time-unit "
    "--angle-unit --topic --effort --stamp --workers --json"
)
arguments = st.just("") | any_of(
    "x 0 -1 1 nan inf 1e308 1e-308 99999 false joint_1=nan joint_1=1e308 joint_1 joint_1,joint_1 "
    "= , 1_0 consistent wls ms deg ٣ a=b=c"
)
command_lines = st.tuples(
    any_of("identify doctor track convert inspect compare validate"),
    st.lists(st.tuples(flags, arguments), min_size=1, max_size=3),
)


def run_flags(example, folder):
    command, given = example
    path, out = folder / "fit.csv", folder / "out"
    write_log(good_log(200), path)
    flat = [word for pair in given for word in pair[: 1 if pair[0] == "--json" else 2]]
    own = {"convert": [path, folder / "out.csv"]}.get(command, [URDF, path])
    written = ["--out", out] if command in ("identify", "track") else []
    obey(command, *own, *written, *flat, out=out)


# --- results -------------------------------------------------------------------------------------


@cache
def good_result():
    """Return a folder with a result, and the content of its result.json."""
    folder = Path(tempfile.mkdtemp(prefix="robotid-fuzz-"))
    write_log(good_log(300), folder / "fit.csv")
    assert obey("identify", URDF, folder / "fit.csv", "--out", folder) == 0
    return folder, (folder / "result.json").read_text()


def places(value, path=()):
    """Yield the path of every value inside a value."""
    yield path
    if isinstance(value, list):
        value = dict(enumerate(value))
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from places(inner, (*path, key))


@cache
def result_places():
    found = list(places(json.loads(good_result()[1])))
    # those near the top and those deep inside are tried as often
    return [[path for path in found if len(path) == depth] for depth in range(6)]


MARKUP = '"><script>alert(1)</script>'
ODD_JSON = [None, [], {}, MARKUP, "\ud800", [MARKUP], {MARKUP: MARKUP}]
replacements = values | st.sampled_from(ODD_JSON)


def edited(content, given):
    """Return a JSON value with values at some places put, dropped or added: path, action, value."""
    for path, action, value in given:
        value = copy.deepcopy(value)
        if not path:
            content = value
            continue
        try:
            inside = content
            for key in path[:-1]:
                inside = inside[key]
            if action == "drop":
                del inside[path[-1]]
            elif action == "add" and isinstance(inside, list):
                inside.append(value)
            else:
                inside[path[-1]] = value
        except (KeyError, IndexError, TypeError):  # an earlier edit took that place away
            continue
    return content


def edits(places, new=replacements, least=0, most=2):
    """Return a strategy of what is done with values at some of the places of a JSON value."""
    actions = st.sampled_from(["put", "put", "drop", "add"])
    place = st.sampled_from(places) if isinstance(places, list) else places
    return st.lists(st.tuples(place, actions, new), min_size=least, max_size=most)


@st.composite
def results(draw):
    """The text of a result.json with values of any shape."""
    deep = st.one_of(*(st.sampled_from(some) for some in result_places()))
    given = draw(edits(deep, least=1, most=3))
    text = json.dumps(edited(json.loads(good_result()[1]), given))
    return broken(draw, text, ["[" * 5000, "", "\0", "9" * 5000, "é"])


def run_result(text, folder):
    good, _ = good_result()
    path, page, replay = (folder / x for x in ("result.json", "page.html", "replay.html"))
    path.write_text(text, encoding="utf-8")
    for name in ("planar_2r.identified.urdf", "planar_2r.identified.drive.json"):
        (folder / name).write_bytes((good / name).read_bytes())
    obey("validate", path, good / "fit.csv")
    obey("compare", path, good / "result.json", "--out", page, out=page)
    obey("compare", good / "result.json", path, "--json")
    obey("replay", URDF, good / "fit.csv", path, "--html", replay, out=replay)
    for made in (page, replay):
        if made.exists():
            assert "<script>alert" not in made.read_text(encoding="utf-8"), "markup is not escaped"


# --- all of them ---------------------------------------------------------------------------------

FILES = [*(f"log{x}" for x in (*READERS, ".mcap", ".bag", ".db3")),
         "plain.npz", "plain.mat", "plain.h5"]  # fmt: skip


def read_as(suffix, write=None):
    return partial(read_log_file, write or READERS[suffix], suffix)


#: By name: a strategy of examples, and what is done with one in an empty folder.
KINDS = {
    **{
        f"bytes of {name}": (
            spoilt(name), read_as(Path(name).suffix, lambda new, path: path.write_bytes(new))
        )
        for name in FILES
    },
    **{f"values in {suffix}": (columns(), read_as(suffix)) for suffix in READERS},
    "headers in .npz": (headers(), read_as(".npz", write_members)),
    "arrays in .npz": (arrays, read_as(".npz")),
    "structure of .h5": (odd_hdf5, read_as(".h5", write_odd_hdf5)),
    "structure of .mat": (
        st.dictionaries(keys, cells, max_size=4), read_as(".mat", write_odd_mat)
    ),
    "values, identified": (columns(300, st.sampled_from(MILD)), identify_from),
    "job file": (jobs(), run_job_file),
    "flags": (command_lines, run_flags),
    "result.json": (results(), run_result),
    "URDF": (urdf_inputs(), run_urdf),
}  # fmt: skip
