import fcntl
import gc
import os
import sys
from functools import lru_cache
from pathlib import Path

# one thread of BLAS per process, before numpy loads it: the workers of pytest-xdist share the cores
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# the package is compiled once, not by each process and each program that tests start
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
gc.disable()  # until the tests begin: nothing that is imported is garbage

import numpy as np
import pytest
from helpers.browsing import launch
from helpers.driven import arm
from helpers.paths import IN_CI, ROOT, URDF
from helpers.synthetic import exact_log, truth
from numba.core.event import Listener, register

from robotid.cli.identify import identify
from robotid.data.files.read import read_log, write_log
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.robot import bodies
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

# every second worker of pytest-xdist collects from the end: modules that one has compiled the other
# finds compiled
WORKER = os.environ.get("PYTEST_XDIST_WORKER", "")
FROM_THE_END = WORKER.endswith(("1", "3", "5", "7", "9"))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Turn round the entries of folders in every second worker."""
    report = yield
    if FROM_THE_END and isinstance(collector, pytest.Directory):
        report.result.reverse()
    return report


#: What takes longest begins first: of the first two files, one compiles and the other does not.
LONGEST = (
    "dynamics/test_compiled.py diagnosis/logs/test_example_robots.py "
    "dynamics/simulation/test_loops.py identification/test_floating_base.py test_docs.py "
    "diagnosis/logs/test_diagnosis.py diagnosis/residual/test_discrepancies.py "
    "cli/test_real_recordings.py output/viewer/test_browser.py estimation/test_workers.py "
    "figures/test_loops.py identification/test_long_recordings.py cli/test_five_minutes.py "
    "identification/closed_loop/test_limits.py cli/test_long_work.py test_hostile_inputs.py"
)


def pytest_configure(config):
    config.option.loadscopereorder = False  # by number of tests, as pytest-xdist would


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Give all workers one order of files."""
    ranks = {ROOT / "tests" / name: rank for rank, name in enumerate(LONGEST.split())}
    if WORKER:
        items.sort(key=lambda item: (ranks.get(item.path, len(ranks)), str(item.path)))


class TakeTurns(Listener):
    """Let one worker at a time compile by Numba: the others find in the cache what it compiled."""

    lock, depth = os.open(__file__, os.O_RDONLY), 0

    def on_start(self, event):
        self.depth += 1
        fcntl.flock(self.lock, fcntl.LOCK_EX)

    def on_end(self, event):
        self.depth -= 1
        if not self.depth:
            fcntl.flock(self.lock, fcntl.LOCK_UN)


if WORKER:
    register("numba:compiler_lock", TakeTurns())


def pytest_collection_finish():
    """Exempt what was imported from the searches of the garbage collector, and make them rarer."""
    gc.freeze()
    gc.set_threshold(20_000)
    gc.enable()


@pytest.fixture(scope="session")
def model():
    return arm()


@pytest.fixture(scope="session", autouse=True)
def meshes():
    """Read each mesh once for the points of bodies: most tests look at the same few robots."""
    read = lru_cache(64)(lambda path, _, read=bodies.read_surfaces: read(path))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bodies, "read_surfaces", lambda path: read(path, path.stat().st_mtime_ns))
        yield


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def ur5():
    return RobotModel.from_urdf(example_urdf("ur5_robot.urdf"))


@pytest.fixture(scope="session")
def four(ur5):
    """The first four joints of a UR5."""
    return RobotModel.from_urdf(ur5.tree, joints=ur5.joints[:4])


@pytest.fixture(scope="session")
def planar():
    return RobotModel.from_urdf(URDF / "planar_2r.urdf")


@pytest.fixture(scope="session")
def panda():
    arm = [f"panda_joint{i}" for i in range(1, 8)]
    return RobotModel.from_urdf(example_urdf("panda.urdf"), joints=arm)


@pytest.fixture(scope="session")
def recordings():
    """The folder of real recordings, which are never part of the project."""
    for folder in (os.environ.get("ROBOTID_DATA"), ROOT.parent / "shared" / "data"):
        if folder and Path(folder).is_dir():
            return Path(folder)
    assert not IN_CI, "CI must not skip the real recordings: set ROBOTID_DATA"
    pytest.skip("no real recordings: set ROBOTID_DATA to their folder")


@pytest.fixture(scope="session")
def browser():
    """The system's Chromium; see browsing.py."""
    yield from launch()


@pytest.fixture(scope="session")
def identified(ur5, tmp_path_factory):
    """A UR5 identified from files of synthetic logs; no two of its figures are alike."""
    # Two logs were fitted, one was kept apart and has a gap; noise differs from joint to joint, and
    # is so large that prior and data, and WLS and the estimate, say different things.
    folder, rng = tmp_path_factory.mktemp("identified"), np.random.default_rng(7)
    noise = np.array([4.0, 8.0, 6.0, 1.6, 1.0, 0.6])  # [N m]
    logs = {}
    for name, samples, rate in (("first", 180, 50.0), ("second", 140, 40.0), ("kept", 300, 50.0)):
        log = exact_log(ur5, truth(ur5), rng, samples=samples, rate=rate, noise=noise)
        rows = np.ones(samples, dtype=bool)
        rows[120:150] = name != "kept"
        parts = {key: getattr(log, key)[rows] for key in ("t", "q", "v", "a", "tau")}
        write_log(Log(joints=log.joints, **parts), folder / f"{name}.csv")
        logs[name] = read_log(folder / f"{name}.csv", ur5.joints)
    return identify(
        ur5,
        [logs["first"], logs["second"]],
        validation=[logs["kept"]],
        signals=SignalSettings(cutoff=12.0, min_velocity=0.05),
    )


@pytest.fixture(scope="session")
def crane(tmp_path_factory):
    """A crane of which drives and delay are identified from commands: two logs, one held out."""
    from helpers.crane import identified_crane  # MuJoCo is not among the least dependencies

    return identified_crane(tmp_path_factory.mktemp("crane"))
