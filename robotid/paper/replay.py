"""The paper's arm on its program motion, with what each iteration makes of the torque."""

from pathlib import Path

import numpy as np

from robotid.paper.dynamics import PlanarDynamics, torque
from robotid.paper.planar_2r import program_motion, urdf_text
from robotid.paper.study import AMPLITUDE, DURATION, ModelStudy
from robotid.robot.model import RobotModel
from robotid.viewer.replays import Torques, write_replay

__all__ = ["write_paper_replay"]

_SAMPLES = 241


def write_paper_replay(study: ModelStudy, folder: Path) -> None:
    """Write planar_2r.urdf and replay.html: the program motion (28) and its torques.

    Args:
        study: The physical arm's study, whose parameters are those of the URDF.
        folder: Where to write.

    References:
        Tzvetkova, (14), (28).
    """
    (folder / "planar_2r.urdf").write_text(urdf_text(), encoding="utf-8")
    model = RobotModel.from_urdf(folder / "planar_2r.urdf")
    t = np.linspace(0.0, DURATION, _SAMPLES)
    q, v, a = program_motion(t, np.array(AMPLITUDE), DURATION)
    dynamics = PlanarDynamics("corrected")
    estimates = study.history.estimates[:, 0]
    last = len(estimates) - 1
    guesses = {"first guess": estimates[0], f"after {last} iterations": estimates[-1]}
    write_replay(
        model,
        t,
        q,
        folder / "replay.html",
        torques=Torques(
            t,
            torque(dynamics, q, v, a, study.P),
            {label: torque(dynamics, q, v, a, P) for label, P in guesses.items()},
        ),
        notes=["Program motion (28); arcs are coloured by the residual of the first guess."],
    )
