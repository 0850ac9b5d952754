"""Which reading of the torques is reported, with whose figures."""

from types import SimpleNamespace

import numpy as np

from robotid.diagnosis.logs import torque_checks as torques
from robotid.diagnosis.logs.hypotheses import Explanation

PROBE = SimpleNamespace(
    model=SimpleNamespace(joints=("a", "b", "c", "d")), gravity=np.array([0.0, 0.0, -9.81])
)
STATED = Explanation("stated", np.array([0.9, 0.6, 0.05, 0.5]))


def reading(kind, share, joints=(), values=()):
    best = Explanation(kind, np.array(share), joints, values)
    return torques._Reading(PROBE, STATED, best, "run.csv")
