"""What is mounted on the last link: parts that the URDF has, loads that only some logs have."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from robotid._typing import Array
from robotid.doctor.hypotheses import own_share
from robotid.doctor.loads import LoadModel, load_model
from robotid.doctor.sample import Probe
from robotid.findings import Finding, listed, log_finding
from robotid.robot.bodies import link_places

__all__ = ["check_payload_change", "check_unmounted_parts"]

_LIGHTER = 4.0  # drop of the misfit, of a factor 7 in likelihood, from which a part is missed
_ALIKE = 2.0  # misfits that differ by less are alike
_LIGHT = 0.02  # of the arm's mass, below which a part is not missed
_NO_LOAD = 1e-6  # [kg, kg m] spread of a payload that is left out
_SURE = 3.0  # standard errors that a change of load has at least
_NOTHING = 0.01  # ... and share of the arm's mass
_CHANGED = 25.0  # drop of the misfit, as of five standard errors, that makes a load believable
_FITS = 0.25  # in variances of its precision, that a torque may fit worse than by itself


def check_unmounted_parts(probe: Probe, share: Array, name: str) -> Iterator[Finding]:
    """Yield a warning "unmounted_part" if the torques fit better without a part of the last link.

    Parts are links that fixed or locked joints hang on the link that the last joint moves, with
    all that hangs on them.

    Args:
        probe: The motion; signs, order, scale and gravity must be right.
        share: Share of each torque's variance that no physics explains, shape (n,).
        name: What the log is called.
    """
    model = load_model(probe, share)
    whole, loaded = _misfit_without_load(model), model.fit(np.ones(len(share)))[0]
    arm = float(probe.model.standard_parameters()[: probe.model.layout.n_inertial : 10].sum())
    trials = []
    for links, parameters in _parts(probe):
        pi = probe.model.standard_parameters()
        size = probe.model.layout.n_inertial
        pi[size - 10 : size] -= parameters
        if pi[size - 10] > 0 and parameters[0] > _LIGHT * arm:
            lighter = replace(probe, model=probe.model.with_parameters(pi))
            left = _misfit_without_load(load_model(lighter, share))
            trials.append((left, links, float(parameters[0])))
    left, links, mass = min(trials, default=(np.inf, [], 0.0))
    # any load, of either sign, must not explain the torques much better
    if left > min(whole - _LIGHTER, loaded + _ALIKE):
        return
    gain = whole - left
    last = probe.model.layout.bodies[-1]
    message = (
        f"the torques fit the URDF better without {listed(links, 4)}, which weigh {mass:.3g} kg in "
        f"all on {last}: if they were not mounted, take them out of the URDF; else {last} is "
        "lighter than the URDF says"
    )
    evidence = {"mass": mass, "gain": gain}
    yield log_finding(name, "unmounted_part", "warning", message, last, **evidence)


def check_payload_change(fitted: Sequence[Probe], kept: Probe, name: str) -> Iterator[Finding]:
    """Yield a warning "payload_change" if a validation log has another load than the fitted ones.

    Links and the load that all logs share are unknown, so that only the change counts.

    Args:
        fitted: Motions that are fitted.
        kept: The motion that is kept apart.
        name: What its log is called.
    """
    models = [load_model(probe, own_share(probe, any_load=True)) for probe in (*fitted, kept)]
    shared = len(models[-1].mean)
    rows = [_rows(model, is_changed=model is models[-1]) for model in models]
    spread = np.append(models[-1].spread, models[-1].spread[-4:])
    mean = np.append(models[-1].mean, np.zeros(4))
    prior = np.column_stack([np.eye(shared + 4), mean / spread])
    X = np.vstack([*(part * np.append(spread, 1.0) for part in rows), prior])
    R = np.asarray(np.linalg.qr(X, mode="r"))
    left = R[-1, -1] ** 2
    gain = float(np.sum(R[shared:-1, -1] ** 2))
    expected = sum(model.expected for model in models)
    if left - expected > _FITS * sum(model.independent for model in models) or gain < _CHANGED:
        return
    inverse = np.linalg.inv(R[:-1, :-1])
    x, error = spread * (inverse @ R[:-1, -1]), spread * np.linalg.norm(inverse, axis=1)
    mass, std_error = float(x[shared]), float(error[shared])
    arm = float(np.sum(kept.model.standard_parameters()[: kept.model.layout.n_inertial : 10]))
    if not max(_SURE * std_error, _NOTHING * arm) <= abs(mass) <= arm:
        return  # nothing but where mass lies, as other errors of a model do; or no load of this arm
    link = kept.model.layout.bodies[-1]
    message = (
        f"{link} carries {abs(mass):.2g} +- {std_error:.1g} kg {'more' if mass > 0 else 'less'} "
        "than in the fitted logs: this log does not test the same robot; record it with the same "
        "load, or fit it by itself"
    )
    evidence = {"mass": mass, "std_error": std_error, "gain": gain}
    yield log_finding(name, "payload_change", "warning", message, link, **evidence)


def _rows(model: LoadModel, *, is_changed: bool) -> Array:
    """Return a log's rows of links, shared load, change of the load and torque, (N, c + 5)."""
    rows = model.R.reshape(-1, model.R.shape[2])
    change = rows[:, -5:-1] if is_changed else np.zeros((len(rows), 4))
    return np.hstack([rows[:, :-1], change, rows[:, -1:]])


def _misfit_without_load(model: LoadModel) -> float:
    spread = np.append(model.spread[:-4], np.full(4, _NO_LOAD))
    return replace(model, spread=spread).fit(np.ones(len(model.R)))[0]


def _parts(probe: Probe) -> Iterator[tuple[list[str], Array]]:
    """Yield the links of each part on the last link, and their inertial parameters, (10,)."""
    last = len(probe.model.layout.bodies) - 1
    places = {p.link: p for p in link_places(probe.model) if p.body == last and p.role != "moved"}
    parent = {joint.child: joint.parent for joint in probe.model.tree.joints}
    told = set()
    for root in places:
        links = [link for link in places if root in _ancestry(link, parent)]
        heavy = [link for link in links if places[link].parameters[0] > 0]
        if heavy and tuple(heavy) not in told:
            told.add(tuple(heavy))
            yield heavy, np.sum([places[link].parameters for link in heavy], axis=0)


def _ancestry(link: str, parent: dict[str, str]) -> Iterator[str]:
    """Yield a link and all that it hangs on."""
    yield link
    while link in parent:
        link = parent[link]
        yield link
