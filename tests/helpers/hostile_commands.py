"""Hostile inputs of excite, simulate, LeRobot datasets and drives, as ``hostile_inputs``."""

import json
import shutil
import tempfile
import xml.etree.ElementTree as ET
from functools import cache, partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hypothesis import strategies as st

from helpers.hostile_inputs import (
    JOINTS,
    MARKUP,
    MILD_OF,
    URDF,
    columns,
    edited,
    edits,
    good_log,
    good_result,
    obey,
    places,
    plain,
    rarely,
    replacements,
    run_job,
    settings_of,
    toml_file,
    write_csv,
)
from helpers.hostile_urdfs import HostileUrdf, any_of, robots, write_urdf_files
from helpers.recorders import write_lerobot
from robotid.data.files.read import write_log
from robotid.data.log import Log
from robotid.dynamics.simulation.simulation_settings import Simulation
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.robot.drives import FAMILIES

numbers = any_of("0 -1 1 2 0.5 1e-9 1e-300 1e9 1e300 100000 nan inf x") | st.just("")
wild = numbers | any_of("1e6 1e-6 0.1 10 1e12")
of_joint = st.tuples(st.sampled_from([*JOINTS, *JOINTS, "x", ""]), wild).map("=".join)


def flagged(pairs):
    """Return the words of flags with their arguments."""
    return [word for pair in pairs for word in pair]


# --- robotid excite ------------------------------------------------------------------------------

#: What a flag may be, to its ends.
RANGED = {
    "--duration": ["0.1", "0.5", "1", "600", "3600"],
    "--harmonics": ["2", "3", "20", "100"],
    "--share": ["0.001", "0.5", "1"],
    "--clearance": ["none", "0", "-0.01", "0.01", "0.3", "1000"],
    "--floor": ["-1000", "-0.5", "0", "0.05", "1000"],
    "--starts": ["1", "2"],
    "--seconds": ["0.001", "0.1"],
    "--points": ["0.1", "1", "1000", "100000"],
    "--criterion": ["A", "E", "condition", "widest", "D"],
    "--given": ["RESULT", "RESULT", "no", ""],
    "--joints": ["joint_1", "joint_2,joint_1", "joint_2", "x", "", ","],
}
BOXES = ["a=-1,-1,-1,1,1,1", "=0,0,0,0,0,0", f"{MARKUP}=2,2,2,3,3,3", "a=1,1,1,0,0,0", "a=nan"]


ranged = st.sampled_from([(flag, word) for flag, some in RANGED.items() for word in some])
excite_flags = st.one_of(
    ranged,
    ranged,
    st.tuples(st.sampled_from([*sorted(RANGED), "--seed", "--gain"]), numbers),
    st.tuples(any_of("--max-acceleration --max-jerk --max-power --noise --lock"), of_joint),
    st.tuples(st.just("--box"), st.sampled_from(BOXES)),
    st.tuples(st.just("--kind"), any_of("fourier sweeps stands")),
)
excitements = st.tuples(
    st.just(Path(URDF).read_bytes()) | robots().map(ET.tostring),
    st.sampled_from([".csv"] * 8 + [".parquet", ".yaml", ".script", ".txt", ""]),
    st.lists(excite_flags, max_size=4),
)


def run_excite(example, folder):
    robot, suffix, given = example
    given = [(flag, str(good_result()[0]) if x == "RESULT" else x) for flag, x in given]
    urdf, out = write_urdf_files(HostileUrdf(robot), folder), folder / "made"
    out.mkdir()
    quick = ["--starts", "1", "--seconds", "0.2", "--harmonics", "2", "--duration", "3"]
    obey(
        "excite", urdf, "--out", out / f"motion{suffix}", "--report", out / "page.html",
        *quick, *flagged(given), out=out,
    )  # fmt: skip
    page = out / "page.html"
    if page.exists():
        assert "<script>alert" not in page.read_text(encoding="utf-8"), "markup is not escaped"


# --- robotid simulate ----------------------------------------------------------------------------


simulate_flags = st.one_of(
    st.tuples(any_of("--seed --rate --duration --perturb --torque-noise --limits --payload"), wild),
    st.tuples(st.just("--controller"), any_of("pd feedforward computed_torque perfect x")),
    st.tuples(st.just("--joints"), st.sampled_from(["joint_1", "joint_2,joint_1", "x", ""])),
    st.tuples(st.just("--lock"), of_joint),
)
#: Tables of a plant, flags, a motion or None for a good one, and what is written.
simulations = st.tuples(
    settings_of(Simulation.schema() | {"drives": {"joint_1": (list,)}}),
    st.lists(simulate_flags, max_size=3),
    st.none() | columns(),
    st.sampled_from([".csv", ".csv", ".npz", ".x"]),
)


def run_simulate(example, folder):
    plant, given, motion, suffix = example
    path, out = folder / "motion.csv", folder / "made"
    out.mkdir()
    if motion is None:
        write_log(good_log(), path)
    else:
        write_csv(motion, path)
    (folder / "plant.toml").write_text(toml_file(plant), encoding="utf-8")
    obey(
        "simulate", URDF, path, "--rate", "100", "--plant", folder / "plant.toml",
        "--out", out / f"log{suffix}", "--urdf", out / "true.urdf", *flagged(given), out=out,
    )  # fmt: skip


# --- LeRobot datasets ----------------------------------------------------------------------------


@cache
def good_dataset():
    """Return a folder with a dataset, and the content of its info.json."""
    folder = Path(tempfile.mkdtemp(prefix="robotid-fuzz-")) / "set"
    log = good_log()
    names = [f"{name}.pos" for name in JOINTS]
    named = {"observation.state": names, "action": names}
    write_lerobot(folder, {0: (np.rad2deg(log.q), np.rad2deg(log.q))}, named)
    return folder, (folder / "meta" / "info.json").read_text(encoding="utf-8")


odd_names = st.sampled_from(
    [None, 5, "joint_1", ["joint_1"] * 2, ["joint_1", ["joint_2"]], {"motors": 5}, {"a": {"b": []}},
     [None, None], [""], ["joint_1.pos", "joint_1"], [".pos", ".vel"], ["a\0b", "\ud800"],
     ["joint_1", "joint_2", "joint_3"], [["joint_1", "joint_2"]], [MARKUP, "x" * 3000]]
)  # fmt: skip
odd_columns = any_of("drop null text ragged scalar huge empty index two-files no-rows bytes")


@st.composite
def datasets(draw):
    """The text of an info.json, and what is done with the table of the episode."""
    content = json.loads(good_dataset()[1])
    content = edited(content, draw(edits(list(places(content)), replacements | odd_names)))
    features = content.get("features") if isinstance(content, dict) else None
    if isinstance(features, dict) and draw(st.booleans()):
        feature = draw(any_of("observation.state action observation.effort"))
        odd = {"names": odd_names, "shape": st.sampled_from([[2], None, 5])}
        features[feature] = draw(st.fixed_dictionaries(odd) | replacements)
    text = json.dumps(content)
    if draw(st.integers(0, 9)) == 0:
        text = draw(st.sampled_from(["", "[" * 100_000, "{}", "null", text[:-20], "\ufeff" + text]))
    column = draw(any_of("observation.state action timestamp episode_index frame_index"))
    return text, draw(st.none() | odd_columns), column, draw(st.sampled_from(TOPICS))


TOPICS = [None, None, None, "episode_0", "episode_1", "0", "-1", "x", "9" * 5000, "²", "٠"]


def run_dataset(example, folder):
    text, what, column, topic = example
    path = folder / "set"
    shutil.copytree(good_dataset()[0], path)
    (path / "meta" / "info.json").write_text(text, encoding="utf-8", errors="surrogatepass")
    spoil_dataset(next(path.glob("data/**/*.parquet")), what, column)
    words = [] if topic is None else ["--topic", topic]
    obey("doctor", URDF, path, "--angle-unit", "deg", *words)
    obey("convert", path, folder / "out.csv", *words, out=folder / "out.csv")


def spoil_dataset(path, what, column):
    """Write a table whose columns hold something else."""
    table = pq.read_table(path)
    place, rows = table.column_names.index(column), table.num_rows
    other = {
        "null": pa.nulls(rows),
        "text": pa.array(["x"] * rows),
        "ragged": pa.array([[1.0] * (k % 4) for k in range(rows)]),
        "scalar": pa.array(np.arange(rows)),
        "huge": pa.array([[1e308, -1e308]] * rows),
        "empty": pa.array([[]] * rows, type=pa.list_(pa.float32())),
        "index": pa.array([2**62 + k for k in range(rows)]),
    }
    lacking = table.remove_column(place)
    if what == "two-files":
        pq.write_table(lacking, path.with_name("other.parquet"))
    elif what == "bytes":
        path.write_bytes(path.read_bytes()[:200])
    elif what is not None:
        changed = {"drop": lacking, "no-rows": table.slice(0, 0)} | {
            key: table.set_column(place, column, values) for key, values in other.items()
        }
        pq.write_table(changed[what], path)


# --- tables of drives in a job file --------------------------------------------------------------

NEEDS = {
    "Stribeck": ["speed"], "Tanh": ["speed"], "Power": ["exponent"], "Harmonic": ["order"],
    "Ramp": ["number", "low", "high"], "LuGre": ["displacement", "speed", "excess"],
    "Presliding": ["displacement"], "PositionCoulomb": ["order", "centre"], "x": ["speed"],
}  # fmt: skip


@st.composite
def drive_terms(draw):
    """A table of a drive's term, most of it as it should be."""
    name = draw(st.sampled_from(sorted(NEEDS)))
    term = {"term": name}
    for key in NEEDS[name]:
        term[key] = draw(plain if draw(rarely) else MILD_OF[float])
    if draw(rarely):
        term["data_range"] = draw(st.sampled_from([[0.0, 1.0], [1.0, 0.0], [1.0], ["x"], {}]))
    return term


drive_lists = st.lists(
    st.one_of(st.sampled_from(sorted(FAMILIES)), drive_terms()), min_size=1, max_size=2
) | st.sampled_from([[], [[]], [{}], [5], "x", ["x"], [None]])
few = st.sampled_from([1.0, -1.0, 2.0, 50.0, 0.5, 1.0, 0.0, 1e-9, 1e30, 1e300, "x"])
gears = st.fixed_dictionaries(
    {
        "joints": st.sampled_from([[*JOINTS], [*JOINTS], ["joint_1"], ["x"], [1]]),
        "matrix": st.sampled_from(
            [[50.0, 50.0], [[50.0, 0.0], [10.0, 50.0]], [[50, 50], [50, -50]], [50.0], "urdf",
             [[1.0, 1.0], [1.0, 1.0]], [], [[]], [[1.0], 2.0], 5, [[1e30, 0], [0, 1e-30]]]
        ),
    },
    optional={
        "motors": st.sampled_from([["m1", "m2"], ["joint_2", "joint_1"], ["m1"], ["", "m"]]),
        "efficiency": st.lists(few, min_size=1, max_size=2),
        "offset": st.lists(few, min_size=1, max_size=2),
    },
)  # fmt: skip
lacking = st.fixed_dictionaries({}, optional={"joints": st.just([*JOINTS]), "matrix": few})
couplings = st.fixed_dictionaries(
    {
        "name": st.sampled_from(["c", "joint_1", "joint_2", "", MARKUP]),
        "ratios": st.dictionaries(st.sampled_from([*JOINTS, *JOINTS, "x"]), few, max_size=3),
    },
    optional={"replaces": st.booleans() | plain},
)
TABLES = {
    "drives": st.dictionaries(
        any_of("joint_1 joint_2 joint_1 joint_2 x"), drive_lists, min_size=1, max_size=2
    ),
    "transmission": st.lists(gears | gears | lacking, min_size=1, max_size=2),
    "coupling": st.lists(couplings, min_size=1, max_size=2),
}


@st.composite
def drive_jobs(draw):
    """The tables of a job file whose drives, gears and couplings are hostile."""
    table = {"estimator": {"name": draw(any_of("ols wls consistent consistent"))}}
    for name in draw(st.lists(st.sampled_from(sorted(TABLES)), min_size=1, max_size=2)):
        table[name] = draw(TABLES[name])
    return table


@st.composite
def loop_jobs(draw):
    """The tables of a job file whose loop is hostile, of one joint: each takes seconds."""
    window = draw(st.sampled_from([0.5, 1.0, 3.0, 1e9, 1e-9]))
    table = {"joints": ["joint_1"], "estimator": {"name": "simulation", "window": window}}
    table["controller"] = draw(settings_of(LoopSettings.schema()))
    if draw(rarely):
        name = draw(st.sampled_from(sorted(TABLES)))
        table[name] = draw(TABLES[name])
    return table


def run_drive_job(table, folder, samples=200):
    log = good_log(samples)
    log = Log(log.t, log.q, log.tau, log.joints, log.v, q_ref=log.q)
    table = {"urdf": URDF, "identification": [{"log": "fit.csv"}]} | table
    run_job(toml_file(table | {"output": {"report": False}}), log, folder)


#: By name: a strategy of examples, and what is done with one in an empty folder.
COMMAND_KINDS = {
    "excite": (excitements, run_excite),
    "simulate": (simulations, run_simulate),
    "LeRobot dataset": (datasets(), run_dataset),
    "drives of a job": (drive_jobs(), run_drive_job),
    "loop of a job": (loop_jobs(), partial(run_drive_job, samples=80)),
}
