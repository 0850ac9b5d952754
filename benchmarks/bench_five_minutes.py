"""From files to a verdict with nothing but the README: commands typed, errors met, seconds waited.

The robot is an arm with a gripper whose drives are logged as currents and whose wrist is coupled:
its URDF, and two logs. One user copies the README's commands and fills its job file with names and
figures of this robot. Another does not read it, types the command line, adds the flags that the
errors name, and writes the job file when a finding asks for what has no flag.

    python benchmarks/bench_five_minutes.py
"""

import argparse
import json
import re
import shlex
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from setting import machine

from robotid.data.files.read import write_columns
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulator import another_robot
from robotid.dynamics.torque import predict_instants
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

README = (Path(__file__).parents[1] / "README.md").read_text()
ARM = [f"panda_joint{i}" for i in range(1, 8)]
FINGERS = {f"panda_finger_joint{i}": 0.02 for i in (1, 2)}  # [m], where they stood
GAINS = dict(zip(ARM, (14.9, 14.9, 11.1, 11.1, 8.3, 8.3, 8.3), strict=True))  # [N m/A]
RATIOS = {"panda_joint6": 1.0, "panda_joint7": 1.0}
#: What the user knows of the robot, by the README's keys.
OWN = {"locked": FINGERS, "gains": GAINS, "ratios": RATIOS}
MOST = 10  # commands after which a user gives up


@dataclass
class User:
    """Someone at a terminal."""

    folder: Path
    commands: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def types(self, command):
        """Run a command of the README; an error is what it says on stderr."""
        program, *words = shlex.split(command)
        assert program == "robotid"
        self.commands.append(command)
        code, said = self.run(words)
        if code:
            self.errors.append(" ".join(said.split()))
        return code == 0

    def run(self, words):
        """Return exit code and stderr of robotid, in a process of its own."""
        command = [sys.executable, "-m", "robotid", *words]
        run = subprocess.run(command, cwd=self.folder, capture_output=True, text=True)
        return run.returncode, run.stderr

    def result(self):
        """Return what was written, a verdict of "none" without it."""
        path = self.folder / "result" / "result.json"
        return json.loads(path.read_text()) if path.is_file() else {"verdict": {"status": "none"}}


def main():
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    print("| user | commands | errors | verdict | s |")
    print("|---|---|---|---|---|")
    for name, act in (("reads the README", reads), ("follows the errors", follows)):
        with tempfile.TemporaryDirectory() as folder:
            record(Path(folder))
            start, user = time.perf_counter(), User(Path(folder))
            act(user)
            seconds = time.perf_counter() - start
            status = user.result()["verdict"]["status"]
        print(f"| {name} | {len(user.commands)} | {len(user.errors)} | {status} | {seconds:.0f} |")
        for error in user.errors:
            print(f"\n{error}\n", file=sys.stderr)
    print(f"\n{machine()}")


def record(folder):
    """Write robot.urdf, first.csv and second.csv of a robot that its URDF does not describe."""
    urdf, rng = example_urdf("panda.urdf"), np.random.default_rng(5)
    (folder / "robot.urdf").write_bytes(urdf.read_bytes())
    wrist = Coupling("motor", tuple(RATIOS.items()))
    model = RobotModel.from_urdf(urdf, locked=FINGERS, couplings=(wrist,))
    truth = another_robot(model, rng)
    for name in ("first", "second"):
        t = np.arange(1200) / 100
        q, v, a = random_fourier(model, rng, period=12.0).evaluate(t)
        tau = predict_instants(model, truth, q, v, a)
        tau += 0.02 * np.std(tau, axis=0) * rng.standard_normal(tau.shape)
        table = {"time": t, **{f"q_{joint}": q[:, k] for k, joint in enumerate(ARM)}}
        table |= {f"q_{finger}": np.full(len(t), place) for finger, place in FINGERS.items()}
        table |= {f"current_{j}": tau[:, k] / GAINS[j] for k, j in enumerate(ARM)}
        write_columns(table, folder / f"{name}.csv")


def block(marker):
    """Return the code under an HTML comment of the README."""
    return re.search(rf"<!-- {marker} -->\n```\w+\n(.*?)```", README, re.DOTALL)[1]


def own_job():
    """Return the README's job file, with the names and figures of this robot."""
    text = block("job: arm")
    for key, own in OWN.items():
        values = ", ".join(f"{name} = {value}" for name, value in own.items())
        text = re.sub(rf"(?m)^{key} = .*", f"{key} = {{ {values} }}", text)
    return text


def reads(user):
    """Write the job file, and give it in the place of URDF and logs where the README says so."""
    (user.folder / "job.toml").write_text(own_job())
    for line in block("cli quick start").strip().splitlines():
        is_job = line.split()[1] in ("doctor", "identify")
        given = r"robot\.urdf first\.csv( --validate second\.csv)?"
        user.types(re.sub(given, "job.toml", line) if is_job else line)


def follows(user):
    """Identify from the command line, with what errors and findings ask for."""
    lines = block("cli quick start").strip().splitlines()
    command = next(line for line in lines if line.split()[1] == "identify")
    while not user.types(command) and len(user.commands) < MOST:
        flags = re.findall(r"--(?:gain|lock) (\w+)=", user.errors[-1])
        assert flags, f"this error names no flag: {user.errors[-1]}"
        for name in flags:
            own = f"--lock {name}={FINGERS[name]}" if name in FINGERS else ""
            command += f" {own or f'--gain {name}={GAINS[name]}'}"
    asked = [w["message"] for w in user.result().get("warnings", ()) if w["code"] == "coupling"]
    for message in asked[:1]:
        assert "Add [[coupling]] to the job: name = " in message
        assert all(f"{joint} = 1.0" in message for joint in RATIOS)
        (user.folder / "job.toml").write_text(own_job())
        user.types("robotid identify job.toml --out result")


if __name__ == "__main__":
    main()
