"""Checks of the last link: parts of the URDF that are not mounted, loads of some logs only."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.special

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.logs.loads import LoadModel, load_model
from robotid.diagnosis.logs.torque_sample import Probe
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Reduction, compress_segments
from robotid.dynamics.rows import keep_inertial_rows
from robotid.dynamics.used_rows import base_problem, row_mask
from robotid.estimation.estimators.two_runs import payload_runs
from robotid.robot.bodies import link_places
from robotid.robot.model import RobotModel
from robotid.robot.prior import payload_spread, prior_spread

_LIGHTER = 4.0  # decrease of the misfit, a likelihood ratio of 7, from which a part is not mounted
_ALIKE = 2.0  # smallest significant difference of misfits
_LIGHT = 0.02  # of the arm's mass, below which a part is not checked
_NO_LOAD = 1e-6  # [kg, kg m] prior standard deviation of a payload that is left out
_P_VALUE = 3e-7  # of a log without another load, five standard errors
_NOTHING = 0.01  # of the arm's mass, the smallest change of load
_CLEARLY = 1.5  # least ratio of the misfit of other torque scales to that of a load
_ROWS = 2000  # of a motion: more are not independent after the filter
_SEGMENT = 0.4  # [s] longer than the correlation of noise
_SEGMENTS = 24


def check_unmounted_parts(probe: Probe, share: Array, name: str) -> Iterator[Finding]:
    """Yield a warning "unmounted_part" if the torques fit better without a part of the last link.

    Parts are links that fixed or locked joints attach to the link of the last moving joint, with
    all links that they carry.
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
            lighter = probe.of(probe.model.with_parameters(pi))
            left = _misfit_without_load(load_model(lighter, share))
            trials.append((left, links, float(parameters[0])))
    left, links, mass = min(trials, default=(np.inf, [], 0.0))
    # a load of any mass, positive or negative, must not explain the torques much better
    if left <= min(whole - _LIGHTER, loaded + _ALIKE):
        last = probe.model.layout.bodies[-1]
        yield finding(
            "unmounted_part", name, subject=last, link=last, parts=listed(links, 4), mass=mass,
            gain=whole - left,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Segments:
    """Motions of a robot, and the reduced least-squares problems of their segments."""

    model: RobotModel  # The robot
    mapping: BaseMapping  # Standard to base parameters
    motions: Sequence[Trajectory]  # The motions
    min_velocity: float  # Lower bound on the speed of the rows that are used

    @property
    def seconds(self) -> float:
        """Total duration [s]."""
        return sum(float(np.ptp(motion.t)) for motion in self.motions)

    @cached_property
    def reductions(self) -> tuple[Reduction, ...]:
        """The reduced problem of each segment, in order."""
        return tuple(part for motion in self.motions for part in self._of(motion))

    def _of(self, motion: Trajectory) -> Iterator[Reduction]:
        thin = motion.every(max(1, len(motion.t) // _ROWS))
        keep_inertial_rows(self.model, thin)  # used for the excitation, too
        count = int(np.clip(np.ptp(thin.t) / _SEGMENT, 1, _SEGMENTS))
        length = -(-len(thin.t) // count)
        rows = row_mask(self.model, thin, self.min_velocity)
        problem = base_problem(self.model, self.mapping, thin, rows, compiled=False)
        for i, factors in enumerate(compress_segments(problem, length)):
            part = thin.part(i * length, (i + 1) * length)
            yield Reduction(factors, part.squares, len(part.t))


def check_payload_change(
    fitted: Segments, validation: Segments, signals: SignalSettings, name: str
) -> Iterator[Finding]:
    """Yield a warning "payload_change" if a validation log has another load than the fitted ones.

    Both are fitted together, with free parameters of all links and a load in the last link of the
    validation log only. The load is reported if the same robot with it fits both.
    """
    model, mapping = fitted.model, fitted.mapping
    first, second, layout = fitted.reductions, validation.reductions, model.layout
    every = (*first, *second)
    squares, samples = sum(r.squares for r in every), sum(r.samples for r in every)
    size = payload_spread(model)
    last = mapping.K[:, layout.n_inertial - 10 : layout.n_inertial]
    seconds = fitted.seconds + validation.seconds
    runs = payload_runs(
        first,
        second,
        layout,
        mapping.K,
        model.standard_parameters(),
        prior_spread(model, np.asarray(squares), samples),
        (last, np.full(10, np.nan), size),
        share=min(1.0, 2.0 * (signals.cutoff or np.inf) * seconds / samples),
    )
    theta, covariance = runs.alike()
    least = -float(scipy.special.ndtri(_P_VALUE)) * float(np.sqrt(covariance[-10, -10]))
    if abs(theta[-10]) <= max(least, _NOTHING * size[0]):
        return  # standard errors with changes over time are not smaller
    # the load is tested with errors that include changes over time; torque scales are tried below
    found = runs.compare(by_joint=False)
    mass, error = float(found.theta[-10]), float(np.sqrt(found.covariance[-10, -10]))
    half_width = -float(scipy.special.stdtrit(found.freedom[-10], _P_VALUE)) * error
    if not max(half_width, _NOTHING * size[0]) < abs(mass) < size[0]:
        return
    left = runs.residual_ratios(found.theta) - 1.0
    by_scales = runs.residual_ratios_by_scales(runs.D.shape[1] - 10) - 1.0
    if _CLEARLY * left.mean() > by_scales.mean():
        return  # the logs differ by another effect
    link = layout.bodies[-1]
    yield finding(
        "payload_change", name, subject=link, link=link, sense=mass > 0, mass=mass, std_error=error
    )


def _misfit_without_load(model: LoadModel) -> float:
    spread = np.append(model.spread[:-4], np.full(4, _NO_LOAD))
    return replace(model, spread=spread).fit(np.ones(len(model.R)))[0]


def _parts(probe: Probe) -> Iterator[tuple[list[str], Array]]:
    """Yield the links of each part on the last link, and their inertial parameters, (10,)."""
    last = len(probe.model.layout.bodies) - 1
    places = {p.link: p for p in link_places(probe.model) if p.body == last and p.role != "moved"}
    parent = {joint.child: joint.parent for joint in probe.model.tree.joints}
    seen = set()
    for root in places:
        links = [link for link in places if root in _ancestry(link, parent)]
        massive = [link for link in links if places[link].parameters[0] > 0]
        if massive and tuple(massive) not in seen:
            seen.add(tuple(massive))
            yield massive, np.sum([places[link].parameters for link in massive], axis=0)


def _ancestry(link: str, parent: dict[str, str]) -> Iterator[str]:
    """Yield a link and the links that carry it."""
    yield link
    while link in parent:
        link = parent[link]
        yield link
