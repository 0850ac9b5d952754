"""Run the paper's simulation and write its page and numerical results."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from robotid.base.files import check_folder, folder_beside, write_json
from robotid.base.typing import Array, ProgressCallback, ignore_progress
from robotid.base.versions import __version__
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.output.viewer.replays import Torques, replay
from robotid.paper.page import paper_page
from robotid.paper.planar_2r import urdf_text
from robotid.paper.procedure import LoopSettings
from robotid.paper.study import (
    AMPLITUDE,
    CASES,
    DURATION,
    MODELS,
    PROGRAM,
    ModelStudy,
    PaperSettings,
    RandomRuns,
    energy_drift,
    errata,
    paper_arm,
    random_runs,
    study_model,
)
from robotid.robot.model import RobotModel
from robotid.robot.parameters import PAPER_TERMS, to_paper_order

_ENOUGH = 1e-4  # [-] relative error at which the simulation has converged
_SAMPLES = 241  # of the replay


def run_paper(
    folder: str | Path,
    *,
    settings: PaperSettings | None = None,
    progress: ProgressCallback | None = None,
) -> dict[str, Any]:
    """Run the paper's simulation with its three models, write it and return paper.json's content.

    Every file is written in a temporary folder inside the target and then moved.
    """
    chosen = settings or PaperSettings()
    report = progress or ignore_progress
    target = Path(folder)
    check_folder(target, ["paper.html", "paper.json", "planar_2r.urdf", "replay.html"])
    target.mkdir(parents=True, exist_ok=True)
    studies = [
        study_model(name, chosen, progress=_counter(name, chosen.iterations, report))
        for name in MODELS
    ]
    near = _trajectories(chosen, "off", 0.05, chosen.patience, report)
    exact = _trajectories(chosen, "on", 0.0, min(chosen.patience, chosen.iterations), report)
    drift = energy_drift()
    arm, physical = _arm(), studies[list(MODELS).index("physical")]
    content = _content(chosen, studies, near, exact, drift)
    content["inertial_vector"] = _inertial_vector(arm, physical)
    report("drawing", 0, 1, "pages")
    with folder_beside(target) as beside:
        (beside / "planar_2r.urdf").write_text(urdf_text(), encoding="utf-8")
        _write_replay(arm, physical, beside / "replay.html")
        html = paper_page(content, studies, drift)
        (beside / "paper.html").write_text(html, encoding="utf-8")
        write_json(content, beside / "paper.json")
    return content


def _trajectories(
    settings: PaperSettings, where: str, largest: float, most: int, report: ProgressCallback
) -> dict[str, RandomRuns]:
    """Return the random motions of each model; they differ between the models."""
    found = {}
    for k, name in enumerate(MODELS):
        rng = np.random.default_rng([settings.seed, k, int(largest > 0)])
        what = f"{name}, {settings.runs} motions from {where} the program"
        counter = _counter(what, most, report)
        found[name] = random_runs(
            *paper_arm(name), settings.runs, most, rng, largest_offset=largest, progress=counter
        )
    return found


def _content(
    settings: PaperSettings,
    studies: list[ModelStudy],
    near: Mapping[str, RandomRuns],
    exact: Mapping[str, RandomRuns],
    drift: tuple[Array, Mapping[str, Array]],
) -> dict[str, Any]:
    loop, (t, gained) = LoopSettings(), drift
    return {
        "schema_version": 1,
        "robotid": __version__,
        "settings": {
            "iterations": settings.iterations,
            "updates_per_iteration": loop.updates,
            "amplitude_rad": list(AMPLITUDE),
            "duration_s": DURATION,
            "alpha": loop.alpha,
            "beta": loop.beta,
            "first_guess": "P / 2",
            "start_beside_program_rad": list(CASES["clean"].offset),
            "most_iterations_until_PRX_is_zero": settings.longest,
            "random_motions": settings.runs,
            "seed": settings.seed,
        },
        "models": {study.name: _model(study) for study in studies},
        "one_shot": {study.name: study.one_shot_error for study in studies},
        **{case: {s.name: _case(s, case) for s in studies} for case in CASES if case != "clean"},
        "trajectories": {name: runs.to_dict() for name, runs in near.items()},
        "trajectories_on_program": {name: runs.to_dict() for name, runs in exact.items()},
        "errata": [asdict(e) for e in errata(np.random.default_rng(settings.seed))],
        "energy_drift": {
            "duration": float(t[-1]),
            "max_relative": {name: float(np.abs(E).max()) for name, E in gained.items()},
        },
    }


def _model(study: ModelStudy) -> dict[str, Any]:
    return {
        "names": list(study.dynamics.names),
        "P_true": study.P.tolist(),
        "P_hat": study.history.estimates[:, 0].tolist(),
        "relative_error": study.errors().tolist(),
        "prx_norm": study.history.prx[:, 0].tolist(),
        "NA": study.NA,
        "converged": bool(study.errors()[-1] <= _ENOUGH),
    }


def _case(study: ModelStudy, case: str) -> dict[str, Any]:
    errors = study.errors(case)
    tenth = max(1, len(errors) // 10)
    estimates = study.history.estimates[-5 * tenth :, list(CASES).index(case)]  # the later half
    averaged = np.linalg.norm(estimates.mean(axis=0) - study.P) / np.linalg.norm(study.P)
    return {
        "conditions": CASES[case].title,
        "relative_error": errors.tolist(),
        "last_tenth": float(errors[-tenth:].mean()),
        "averaged": float(averaged),
        "converged": bool(errors[-1] <= _ENOUGH),
        "reason": _reason(case, errors),
    }


def _reason(case: str, errors: Array) -> str:
    if errors[-1] <= _ENOUGH:
        return "converged"
    if case == "on_program":
        return "slow: every run follows the same curve, which excites the parameters too little"
    return (
        "A disturbance v is part of the deviation, η = D⁻¹(ΨP̃ + v), and the step (24) does not "
        "decrease with it. The estimate does not converge: it remains in a band about the true "
        "value, with a width proportional to v. Small samples have the same weight as large ones, "
        "since the step is divided by |Ψ|²; a larger ε₂ excludes them."
    )


def _arm() -> RobotModel:
    """Return the physical arm, read from its URDF."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "planar_2r.urdf"
        path.write_text(urdf_text(), encoding="utf-8")
        return RobotModel.from_urdf(path)


def _inertial_vector(arm: RobotModel, study: ModelStudy) -> dict[str, Any]:
    """Return the arm's inertial parameters in the order of (9)-(10), true and identified.

    The identified ones are those nearest to the initial values (half of the true ones) with the
    torque of the estimate, W_b beta = G P^: the torque determines four sums of the twenty.
    """
    pi = arm.standard_parameters()[: arm.layout.n_inertial]
    q, v, a = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 20, 2))
    mapping = structural_mapping(arm, inertial_only=True)
    W_b = joint_torque_regressor(arm, q, v, a)[:, mapping.independent]  # (40, b)
    u = study.dynamics.torque(q, v, a, study.history.estimates[-1, 0])  # (20, 2)
    beta = np.linalg.lstsq(W_b, u.ravel())[0]
    return {
        "names": [f"{body}.{term}" for body in arm.layout.bodies for term in PAPER_TERMS],
        "true": to_paper_order(pi).tolist(),
        "identified": to_paper_order(mapping.to_standard(beta, pi / 2)).tolist(),
    }


def _write_replay(arm: RobotModel, study: ModelStudy, target: Path) -> None:
    """Write the replay of the program motion (28), with the torques of the estimates."""
    t = np.linspace(0.0, DURATION, _SAMPLES)
    q, v, a = PROGRAM.evaluate(t)
    estimates = study.history.estimates[:, 0]
    label = f"after {len(estimates) - 1} iterations"
    torques = Torques(
        t,
        study.dynamics.torque(q, v, a, study.P),
        {
            "initial values": study.dynamics.torque(q, v, a, estimates[0]),
            label: study.dynamics.torque(q, v, a, estimates[-1]),
        },
    )
    notes = ["Program motion (28). Colour of the arcs: residual of the initial values."]
    replay(arm, t, q, torques=torques, notes=notes).write(target)


def _counter(what: str, most: int, report: ProgressCallback) -> Callable[[int], None]:
    return lambda number: report(what, number, most, "iterations")
