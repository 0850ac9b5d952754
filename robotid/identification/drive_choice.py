"""Selection of the terms of each joint's drive: the fewest that explain held-out segments.

Terms are added to viscous and Coulomb friction, joint by joint: the family that explains most is
selected if it is significant, then the next one together with it. Validation logs are not used.
Where the prior binds the bodies, those of least squares replace them: a wrong prior does not become
friction.

The nonlinear parameters of a family, its shape, are searched on a grid, then those of a joint are
refined together (variable projection, Golub, Pereyra 2003).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.tolerances import REMAINDER, TINY
from robotid.base.typing import Array
from robotid.diagnosis import decisions
from robotid.diagnosis.decisions import Round, select
from robotid.diagnosis.residual.term_trials import Sample, Trial, Trials, take_sample
from robotid.dynamics.torque import drive_motion_along
from robotid.estimation.fitting.drive_terms import DriveChoice, FoundShape, Tried, with_shapes
from robotid.estimation.fitting.fitted import Solution
from robotid.robot.drive_term import DataRange, DriveMotion, DriveTerm, Family
from robotid.robot.drives import FAMILIES

_GRID = 6  # values of a shape that are tested
_REVOLUTION = 2 * np.pi  # [rad]
_LOADED = ("load", "lag")  # families that depend on the torque of the drive
_Sized = tuple[Family, list[float]]  # a family and its shapes


@dataclass(frozen=True, eq=False)
class _Drive:
    """A joint's drive along the samples."""

    is_prismatic: bool
    has_load: bool  # whether its torque is known, with no unknown force of a contact or loop
    motions: tuple[DriveMotion, ...]  # of each recording, all its samples
    taken: tuple[Array, ...]  # indices of the samples in each recording
    data_range: DataRange
    plain: Mapping[str, Array]  # columns of U of its plain parameters, by name
    known: dict[DriveTerm, Array] = field(default_factory=dict)  # columns of terms, (N,)

    def columns(self, terms: Sequence[DriveTerm]) -> Array:
        """Return the columns of terms in the samples, shape (N, c)."""
        Z = np.empty((sum(map(len, self.taken)), len(terms)))
        for k, term in enumerate(terms):
            if term not in self.known:
                along = zip(self.motions, self.taken, strict=True)
                self.known[term] = np.concatenate([term.column(m)[rows] for m, rows in along])
            Z[:, k] = self.known[term]
        return Z


def choose_drives(
    fit: Solution, wanted: Mapping[str, Sequence[str] | None]
) -> tuple[DriveChoice, ...]:
    """Return the terms of each joint's drive."""
    sample = take_sample(fit, for_drives=True, is_free=True)
    if sample is None:
        return ()
    choices = []
    for j, drive in _drives(fit, sample, wanted).items():
        names, alone = wanted[sample.joints[j]], sample.of_joint(j)
        choices.append(_auto(alone, drive) if names is None else _fixed(alone, drive, names))
    return tuple(choices)


def _drives(
    fit: Solution, sample: Sample, wanted: Mapping[str, Sequence[str] | None]
) -> dict[int, _Drive]:
    """Return the drives whose families are given or selected, by the index of their joint."""
    model = fit.model.with_reference(sample.standard)
    motions = [drive_motion_along(model, x.trajectory) for x in sample.recordings]
    first = sample.weight.shape[1] - len(sample.joints)
    used = sample.weight[:, first:] > 0
    drives = {}
    for j, joint in enumerate(sample.joints):
        names = wanted[joint]
        if not used[:, j].any() or (names is not None and not names) or joint in fit.model.passive:
            continue
        logged = tuple(motion.of(j) for motion in motions)
        plain = {
            name: sample.U[:, k]
            for k, name in enumerate(fit.mapping.base_names)
            if name.startswith(f"{joint}.")
        }
        taken = [(m.q[rows], m.v[rows]) for m, rows in zip(logged, sample.taken, strict=True)]
        q, v = (np.concatenate(x)[used[:, j]] for x in zip(*taken, strict=True))
        ends = {key: (float(x.min()), float(x.max())) for key, x in (("q", q), ("v", np.abs(v)))}
        is_prismatic, has_load = bool(sample.is_prismatic[j]), sample.basis is None
        drives[j] = _Drive(is_prismatic, has_load, logged, sample.taken, ends, plain)
    return drives


def _candidates(drive: _Drive, families: Sequence[Family]) -> Iterator[_Sized]:
    """Yield families with every shape on its grid."""
    for family in families:
        revolutions = (drive.data_range["q"][1] - drive.data_range["q"][0]) / _REVOLUTION
        bounds = [shape.within(drive.data_range) for shape in family.shapes]
        if family.needs and (drive.is_prismatic or revolutions < family.needs):
            continue
        if not all(0.0 < low < high for low, high in bounds):  # it hardly moved
            continue
        terms = family.make(drive.data_range, *[low for low, _ in bounds])
        if not drive.has_load and any(term.needs_load for term in terms):
            continue
        grids = [np.geomspace(*ends, _GRID).tolist() for ends in bounds]
        yield from ((family, list(sizes)) for sizes in product(*grids))


@dataclass(frozen=True, eq=False)
class _Options:
    """Candidates of a joint, with every shape on the grid, and their residuals."""

    candidates: list[_Sized]
    place: dict[int, list[int]]  # columns of each
    is_positive: Array  # columns whose parameter cannot be negative, bool
    highest: Array  # upper bounds of their parameters
    trials: Trials

    @classmethod
    def of(cls, sample: Sample, drive: _Drive, candidates: list[_Sized]) -> "_Options":
        terms = [_terms(drive, [one]) for one in candidates]
        columns = {i: drive.columns(of_family)[:, None] for i, of_family in enumerate(terms)}
        trials, place = Trials.of(sample, columns)
        flat = [term for of_family in terms for term in of_family]
        positive = np.array([term.is_nonnegative for term in flat], dtype=bool)
        highest = np.array([x.highest for x in flat])
        return cls(candidates, place, positive, highest, trials)

    def name(self, i: int) -> str:
        """Return the family of a candidate."""
        return self.candidates[i][0].name

    def simplicity(self, i: int) -> tuple[int, int]:
        """Return the columns of a candidate, and the place of its family in their order."""
        return len(self.place[i]), list(FAMILIES).index(self.name(i))

    def left(self, chosen: Sequence[int]) -> Array:
        """Return the squared residual of each segment with some candidates."""
        return self.trials.held_out.left(self._columns(chosen))

    def left_each(self, chosen: Sequence[int]) -> dict[int, Array]:
        """Return the squared residual of each segment with those chosen and another candidate."""
        # Of candidates that oppose motion, one family of each kind.
        kinds = {_kind(self.name(k)) for k in chosen}
        other = [i for i in range(len(self.candidates)) if _kind(self.name(i)) not in kinds]
        columns = {i: self._columns([*chosen, i]) for i in other}
        theta = self.trials.whole.parameters_each(columns)
        possible = {
            i: which
            for i, which in columns.items()
            if (theta[i][self.is_positive[which]] >= 0).all()
            and (np.abs(theta[i]) <= self.highest[which]).all()
        }
        return self.trials.held_out.left_each(possible)

    def _columns(self, chosen: Sequence[int]) -> list[int]:
        return [k for i in chosen for k in self.place[i]]


def _kind(name: str) -> str:
    """Return the kind of a family: its name without a number."""
    return name.rstrip("0123456789")


def _auto(sample: Sample, drive: _Drive) -> DriveChoice:
    """Return the fewest families that held-out segments require."""
    grid = list(_candidates(drive, [f for f in FAMILIES.values() if f.is_automatic]))
    every, torque = _Options.of(sample, drive, grid), float(sample.torque[0])
    chosen: list[int] = []
    undecided: list[_Sized] = []
    before = every.left(chosen)
    tried = [Tried((), _percent(before, torque), 1.0, True)]

    def offered() -> Round[int]:
        left, total = every.left_each(chosen), float(before.sum())
        return Round(before, left, len(before), total, decisions.LEAST_TERM**2 * torque)

    def cost(i: int) -> tuple[int, int]:
        return every.simplicity(i)

    for this, best in select(offered, decisions.FAMILY, cost):
        refined = None if best is None else _conditioned(sample, drive, every, this, chosen, best)
        best = None if refined is None else refined.number
        tried += _considered(every, this, torque, chosen, best)
        if refined is None:
            nearest = min(this.left, key=lambda i: float(this.left[i].sum()), default=None)
            if nearest is not None and this.p_value(nearest) < decisions.UNDECIDED_P_VALUE:
                undecided = [every.candidates[nearest]]
            break
        every = _Options.of(refined.weighted, drive, [*refined.families, *grid])
        torque = float(refined.weighted.torque[0])
        chosen = list(range(len(refined.families)))
        before = every.left(chosen)
    choice = _found(sample, drive, [every.candidates[i] for i in chosen], tuple(tried))
    return replace(choice, undecided=_terms(drive, undecided))


@dataclass(frozen=True, eq=False)
class _Refined:
    """A candidate together with those chosen, with shapes refined between the grid's values."""

    number: int
    families: list[_Sized]  # those chosen and the candidate
    weighted: Sample  # the samples with weights from the residual with these
    faults: tuple[bool, bool]  # a shape is at its bound, a standard error increases tenfold


def _conditioned(
    sample: Sample, drive: _Drive, every: _Options, this: Round[int], chosen: Sequence[int],
    best: int,
) -> _Refined:  # fmt: skip
    """Return the best candidate, or an equally good, better conditioned one of another family."""

    # Equally good: by the rule of the selection. Better conditioned: no shape at its bound, or no
    # standard error of the drive increased tenfold.
    def refined(i: int) -> _Refined:
        families = _refined(sample, drive, [every.candidates[k] for k in (*chosen, i)])
        weighted = _reweighted(sample, drive, families)
        is_grown = max(_grown(weighted, drive, families).values(), default=1.0) > decisions.TENFOLD
        return _Refined(i, families, weighted, (bool(_at_bound(drive, families).any()), is_grown))

    def left_of(other: _Refined) -> float:
        return float(_Options.of(sample, drive, other.families).left(range(len(chosen) + 1)).sum())

    first = refined(best)
    if not any(first.faults):
        return first
    left, whole = this.left, float(this.before.sum())
    by_family = _of_families(every, left)
    by_family.pop(every.name(best))
    others = [refined(i) for i in by_family.values() if left[i].sum() < whole]
    most = left_of(first) + decisions.FAMILY.alike * whole
    alike = [x for x in others if x.faults < first.faults and left_of(x) <= most]
    return min((first, *alike), key=lambda x: (x.faults, *every.simplicity(x.number)))


def _considered(
    every: _Options, this: Round[int], torque: float, chosen: Sequence[int], best: int | None
) -> list[Tried]:
    """Return the error that each family would give at its best shape, or as selected."""
    names = [every.name(k) for k in chosen]
    return [
        Tried((*names, name), _percent(this.left[i], torque), this.p_value(i), i == best)
        for name, i in _of_families(every, this.left, best).items()
    ]


def _of_families(
    every: _Options, left: Mapping[int, Array], selected: int | None = None
) -> dict[str, int]:
    """Return of each family the selected candidate, or that with the smallest residual."""
    best_first = sorted(left, key=lambda i: (i != selected, float(left[i].sum())))
    names = dict.fromkeys(map(every.name, left))
    return {name: next(i for i in best_first if every.name(i) == name) for name in names}


def _percent(left: Array, torque: float) -> float:
    return 100.0 * float(np.sqrt(left.sum() / max(torque, decisions.NOTHING)))


def _fixed(sample: Sample, drive: _Drive, names: Sequence[str]) -> DriveChoice:
    """Return the stated families with the shapes that fit best."""
    families = [FAMILIES[name] for name in names]
    every = _Options.of(sample, drive, list(_candidates(drive, families)))
    groups = [[i for i, (f, _) in enumerate(every.candidates) if f.name == name] for name in names]
    missing = [name for name, group in zip(names, groups, strict=True) if not group]
    if missing:
        raise SettingsError(
            f"friction of {sample.joints[0]} has {listed(missing)}, which needs "
            + (
                "a revolute joint and at least half a revolution in the fitted logs; remove it, or "
                "record more motion"
                if drive.has_load or missing[0] not in _LOADED
                else "the joint load torque, which unknown forces of contacts or loops change; "
                "remove it"
            )
        )
    chosen = [group[len(group) // 2] for group in groups]
    for _ in range(3 if len(names) > 1 else 1):  # one after the other, repeated a few times
        for at, group in enumerate(groups):
            rest = [*chosen[:at], *chosen[at + 1 :]]
            chosen[at] = min(group, key=lambda i: float(every.left([*rest, i]).sum()))
    tried = tuple(
        Tried(which, _percent(every.left(columns), float(sample.torque[0])), 1.0, bool(which))
        for which, columns in (((), []), (tuple(names), chosen))
    )
    return _found(sample, drive, [every.candidates[i] for i in chosen], tried)


def _found(
    sample: Sample, drive: _Drive, chosen: Sequence[_Sized], tried: tuple[Tried, ...]
) -> DriveChoice:
    """Return the choice with its shapes refined."""
    refined = _refined(sample, drive, chosen)
    flat, weighted = _flat(refined), _reweighted(sample, drive, refined)
    covariance = np.empty((0, 0))
    if len(flat):
        count, trial = _with_slopes(weighted, drive, refined)
        every = trial.estimate(list(range(count + len(flat))), weighted.fitted)[1]
        covariance = every[count:, count:]
    named = [(family.name, shape) for family, _ in refined for shape in family.shapes]
    errors, is_at_bound = np.sqrt(np.diag(covariance)), _at_bound(drive, refined)
    return DriveChoice(
        joint=sample.joints[0],
        families=tuple(family.name for family, _ in refined),
        terms=_terms(drive, refined),
        tried=tried,
        shapes=tuple(
            FoundShape(
                f"{name}.{shape.name}", float(flat[k]), float(errors[k]),
                shape.units[int(drive.is_prismatic)], bool(is_at_bound[k]),
            )
            for k, (name, shape) in enumerate(named)
        ),
        shape_covariance=tuple(tuple(row) for row in covariance.tolist()),
        sizes=tuple(tuple(sizes) for _, sizes in refined),
        data_range=drive.data_range,
    )  # fmt: skip


def _flat(chosen: Sequence[_Sized]) -> Array:
    """Return all shapes of families in a row, shape (k,)."""
    return np.array([size for _, sizes in chosen for size in sizes])


def _at_bound(drive: _Drive, chosen: Sequence[_Sized]) -> Array:
    """Return which shapes are at a bound of their search range, shape (k,)."""
    bounds = _log_bounds(drive, chosen)
    margin = decisions.AT_BOUND * np.ptp(bounds, axis=1)
    return np.asarray(np.min(np.abs(np.log(_flat(chosen))[:, None] - bounds), axis=1) < margin)


def _grown(sample: Sample, drive: _Drive, chosen: Sequence[_Sized]) -> dict[str, float]:
    """Return the factor by which terms increase the standard error of each plain parameter."""
    # C = (W^T W + 1)^-1 becomes C + T (X^T M X)^-1 T^T, with T = C W^T X, M = 1 - W C W^T.
    if not chosen:
        return {}
    _, trial = _with_slopes(sample, drive, chosen)
    T, S = trial.T[:, :-1], trial.S[:-1, :-1]
    _, before = sample.normal.whole
    grown = {}
    for name, u in drive.plain.items():
        more = u @ T @ np.linalg.solve(S, T.T @ u)
        grown[name] = float(np.sqrt(1.0 + max(more, 0.0) / (u @ before @ u)))
    return grown


def _reweighted(sample: Sample, drive: _Drive, chosen: Sequence[_Sized]) -> Sample:
    """Return the samples with the joint's weights from its residual with the new terms."""
    # Without them the joint's weights would be far too small beside other joints and the prior.
    if not chosen:
        return sample
    terms = _terms(drive, chosen)
    whole = Trials(sample, drive.columns(terms)[:, None]).whole
    before, after = (float(whole.left(which).sum()) for which in ([], list(range(len(terms)))))
    return sample.reweighted(np.sqrt(before / max(after, TINY * before, decisions.NOTHING)))


def _terms(drive: _Drive, chosen: Sequence[_Sized]) -> tuple[DriveTerm, ...]:
    """Return the terms of families with their shapes."""
    return tuple(term for family, sizes in chosen for term in family.make(drive.data_range, *sizes))


def _log_bounds(drive: _Drive, chosen: Sequence[_Sized]) -> Array:
    """Return the logarithms of the search range of each shape, shape (k, 2)."""
    bounds = [shape.within(drive.data_range) for family, _ in chosen for shape in family.shapes]
    return np.asarray(np.log(np.reshape(bounds, (-1, 2))))


def _refined(sample: Sample, drive: _Drive, chosen: Sequence[_Sized]) -> list[_Sized]:
    """Return families with the nearby shapes that give the smallest residual together."""
    from scipy.optimize import minimize

    sized = partial(with_shapes, [family for family, _ in chosen])
    start = np.log(_flat(chosen))
    if not len(start):
        return sized(np.exp(start))
    joined = _reweighted(sample, drive, chosen).joined()

    def left(log_sizes: Array) -> float:
        columns = drive.columns(_terms(drive, sized(np.exp(log_sizes))))
        whole = Trials(joined, columns[:, None], REMAINDER).whole
        (squares,) = whole.left(range(columns.shape[1]))
        return float(np.log(squares + decisions.NOTHING))

    bounds, options = _log_bounds(drive, chosen), {"eps": decisions.STEP}
    best = minimize(left, start, method="L-BFGS-B", bounds=bounds, options=options)
    return sized(np.exp(best.x))


def _with_slopes(sample: Sample, drive: _Drive, chosen: Sequence[_Sized]) -> tuple[int, Trial]:
    """Return the number c of columns of terms, and a trial of them and of d(torque)/d(shape)."""
    families, flat = [family for family, _ in chosen], _flat(chosen)
    Z = drive.columns(_terms(drive, chosen))
    theta = Trials(sample, Z[:, None], REMAINDER).whole.parameters(range(Z.shape[1]))
    slopes = np.empty((len(Z), len(flat)))
    for k, h in enumerate(decisions.STEP * flat):
        larger = flat + h * (np.arange(len(flat)) == k)
        moved = drive.columns(_terms(drive, with_shapes(families, larger)))
        slopes[:, k] = (moved - Z) @ theta / h
    return Z.shape[1], Trials(sample, np.hstack([Z, slopes])[:, None], REMAINDER).whole
