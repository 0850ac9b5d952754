"""Prediction of each log by a fit to the others: the verdict without validation logs."""

from collections.abc import Callable, Collection, Sequence

from robotid.base.exceptions import RankDeficientError
from robotid.base.typing import Array
from robotid.diagnosis.logs.motion_checks import alike_motions
from robotid.dynamics.factors import Factors, merge
from robotid.dynamics.prediction import predict
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.estimation.fitting.metrics import Metrics, TorqueSums
from robotid.robot.model import RobotModel

#: End of the name of a log that a fit to the others predicts.
LEFT_OUT = ", left out of the fit"

#: Smallest number of different motions of which each is predicted by the others.
FEWEST_LEFT_OUT = 3
_FITS = 10  # largest number of fits; more motions are left out together


def left_out_metrics(
    model: RobotModel,
    logs: Sequence[Sequence[Factors]],
    fitted: Sequence[Evaluation],
    fit: Callable[[Factors], tuple[Array, Array]],
) -> dict[str, Metrics]:
    """Return the metrics of each log as a fit to the others predicts it, by its name.

    Logs that repeat the motion of one another are left out together.

    fit (p,).
    """
    if any(e.recording.is_partial for e in fitted):
        return {}
    motions = alike_motions([e.recording.trajectory for e in fitted])
    if len(motions) < FEWEST_LEFT_OUT:
        return {}
    found = {}
    for first in range(min(_FITS, len(motions))):
        out = {k for motion in motions[first::_FITS] for k in motion}
        others = merge([part for k, log in enumerate(logs) if k not in out for part in log])
        try:
            pi, driven = fit(others)
        except RankDeficientError:  # of "ols" and "wls": not evaluated, which the verdict states
            continue
        for k in sorted(out):
            motion, mask = fitted[k].recording.trajectory, fitted[k].recording.mask
            torque, by_urdf = predict(model, [pi, driven], motion)
            torques = fitted[k].torques
            plain = {x: torques[x] for x in ("gravity_only", "urdf") if x in torques}
            plain["urdf_with_drives"] = by_urdf
            sums = TorqueSums.of(motion.tau, torque, mask, plain)
            name = f"{fitted[k].recording.name}{LEFT_OUT}"
            found[name] = sums.metrics(model.row_names, model.row_units)
    return found


def logs_that_test(names: Collection[str]) -> str:
    """Return what the logs are that test a prediction, as text."""
    is_left_out = bool(names) and all(name.endswith(LEFT_OUT) for name in names)
    return "logs left out of the fit in turn" if is_left_out else "validation logs"
