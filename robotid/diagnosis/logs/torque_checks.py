"""Checks of the torques against the model: other readings of the log, masses and loads."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.data.units import STATIC
from robotid.diagnosis import decisions
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import BEYOND_NOISE, NO_ERROR_OF_MASSES, SIGNIFICANT, ZERO
from robotid.diagnosis.logs import readings
from robotid.diagnosis.logs.probe import Probe, drive_columns
from robotid.diagnosis.logs.readings import EXPLAINED, Best, Samples
from robotid.robot.model import RobotModel
from robotid.robot.prior import assumed_masses

_UNEXPLAINED = 0.25  # unexplained share of a torque's variance that is reported, not accepted
_SPREAD = 0.3  # prior standard deviation of a link's mass, relative to the URDF's
_INDEPENDENT, _PER_SECOND = 20.0, 3.0  # independent instants of a log, per second of a short one
_WORSE = 0.25  # allowed increase of a torque's misfit over its own fit, in variances
_OTHER_UNIT = 30.0  # a common scale of all torques farther from 1 is another unit, no gain
_SCALES = np.logspace(-3, 3, 61)
_THINNED = 10  # instants of a log per one with which other readings are sought
_NEAR = {"xatol": 0.01}  # [rad], or of the logarithm of a speed: where the search for them ends
_WRONG_TILT = 30.0  # [deg] angle of gravity from the stated one that is an error
_LARGE = 0.08  # payload over the arm's mass that errors of the links do not explain
_MISMATCH = 7.5  # largest sum of squared errors of the links, in standard deviations
_ORDERS = ("torque_order", "position_order", "joint_order")


@dataclass(frozen=True, eq=False)
class TorqueCheck:
    """The torques of one log as its model explains them, and which limbs they are of."""

    probe: Probe
    limbs: tuple[tuple[Samples, bool], ...]  # and whether other readings of them are tried
    share: Array  # (n,), unexplained share of each torque, 1 of joints at rest

    @classmethod
    def of(cls, probe: Probe) -> "TorqueCheck":
        """Return the check of a log."""
        # the friction of a joint at rest has any value: nothing contradicts its torque
        moves = np.ptp(probe.motion.q[:, -probe.tau.shape[1] :], axis=0) >= STATIC
        used = moves | bool(probe.model.constraints)  # forces of contacts connect all joints
        groups = [(rows[used[rows]], is_tried) for rows, is_tried in readings.limbs(probe.model)]
        samples = tuple((Samples.of(probe, rows, moves), x) for rows, x in groups if len(rows))
        share = np.ones(len(moves))
        for one, _ in samples:
            share[one.motion.rows] = np.minimum(one.share, 1.0)
        return cls(probe, samples, share)

    def read(self, name: str) -> Iterator[Finding]:
        """Yield the other readings that explain the torques."""
        for samples, is_tried in self.limbs:
            if is_tried:
                yield from _findings(samples, list(readings.best_readings(samples)), name)

    def loads(self, name: str) -> Iterator[Finding]:
        """Yield another scale, a load or another robot, and torques that nothing explains."""
        model = self.probe.model
        bad = [j for x, _ in self.limbs for j in x.motion.rows if self.share[j] > _UNEXPLAINED]
        if not (model.constraints or assumed_masses(model)):
            yield from _check_loads(self.probe, self.share, name, not bad)
        if 2 * len(bad) > len(model.joints):
            yield finding(
                "unexplained_torque", name, what="robot", joints=len(bad), of=len(model.joints),
                share=float(np.median(self.share[-len(model.joints) :])),
            )  # fmt: skip
            return
        for j in bad:
            joint = model.row_names[j]
            yield finding("unexplained_torque", name, joint, what="joint", share=self.share[j])


def is_suspect(check: TorqueCheck, others: Sequence[TorqueCheck]) -> bool:
    """Return whether a log explains a torque clearly worse than another log of the robot."""
    least = np.min([one.share for one in others], axis=0)
    return bool((check.share > np.maximum(EXPLAINED, np.exp(readings.CERTAIN) * least)).any())


def _findings(samples: Samples, found: Sequence[Best], log: str) -> Iterator[Finding]:
    """Yield the findings of readings that explain the torques together."""
    rows, joints = samples.motion.rows.tolist(), samples.motion.model.row_names
    final = found[-1].after if found else np.zeros(len(rows))
    if found and (final > decisions.BETTER**2 * found[0].before).all():
        return  # together they explain no torque
    exchanged: dict[str, list[Best]] = {}
    for one in found:
        reading, named = one.reading, one.reading.joints or rows
        # a joint without any torque of the bodies does not confirm that reading
        concerned = np.isin(rows, named) & (one.samples.urdf_size > ZERO * samples.urdf_size)
        is_unit = reading.code == "current_for_torque" and not reading.joints
        if is_unit or (concerned.any() and np.median(final[concerned]) > EXPLAINED):
            continue  # a unit of all torques shows in the masses
        if reading.code in _ORDERS:
            exchanged.setdefault(reading.code, []).append(one)
        elif reading.code in ("torque_sign", "unsigned_torque"):
            of_joint = zip(rows, one.before, one.after, strict=True)
            for j, before, after in (x for x in of_joint if x[1] > 0.0 and x[0] in named):
                yield finding(
                    reading.code, log, joints[j], kind="one", cure="one", unexplained=before,
                    unexplained_if_negated=after, unexplained_with_signs=after,
                )  # fmt: skip
        else:
            yield _finding(samples, one, log)
    for code, pairs in exchanged.items():
        order = np.arange(len(joints))
        for one in pairs:
            first, second = np.split(np.array(one.reading.joints), 2)
            order[[*first, *second]] = order[[*second, *first]]
        moved = np.flatnonzero(order != np.arange(len(joints)))
        owners = [f"tau_{joints[order[j]]} is the torque of {joints[j]}" for j in moved]
        yield finding(
            code, log, [joints[j] for j in moved], owners=", ".join(owners),
            gain=sum(one.gain for one in pairs), unexplained=pairs[0].before.max(),
            unexplained_so_read=pairs[-1].after.max(),
        )  # fmt: skip


def _finding(samples: Samples, one: Best, log: str) -> Finding:
    """Return the finding of a reading."""
    model, reading = samples.motion.model, one.reading
    names = [model.row_names[j] for j in reading.joints]
    worst = int(np.argmax(one.before - one.after))
    others, of_whom = [r for r in one.alike if r.joints], "joint" if names else "robot"
    what = of_whom if reading.code in ("gravity_compensated", "angle_scale") else "log"
    values: dict[str, float | str] = {
        "worst": model.row_names[samples.motion.rows[worst]], "before": one.before[worst],
        "after": one.after[worst], "gain": one.gain, "what": what, "cure": "log",
        "also": bool(others), "others": listed(
            f"{r.code} of {listed(model.row_names[j] for j in r.joints)}" for r in others
        ),
    }  # fmt: skip
    if reading.code == "gravity":
        robots = (x.motion.model.pin_model for x in (reading.of(samples), samples))
        best, stated = (np.array(x.gravity.linear) for x in robots)
        lengths = np.linalg.norm(best) * np.linalg.norm(stated)
        angle = float(np.degrees(np.arccos(np.clip(best @ stated / max(lengths, TINY), -1.0, 1.0))))
        shown = (", ".join(f"{x:.2f}" for x in vector) for vector in (best, stated))
        values |= dict(zip(("best", "stated"), shown, strict=True)) | {"angle_deg": angle}
        values |= dict(zip("xyz", best.tolist(), strict=True))
        values["severity"] = "error" if angle > _WRONG_TILT else "warning"
    elif reading.values:
        key = {"position_offset": "offset", "time_scale": "speed"}.get(reading.code, "factor")
        x = reading.values[0]
        sizes = {"position_offset": x, "angle_scale": 1.0 + x}
        values[key] = sizes.get(reading.code, float(np.exp(-x)))
    return finding(reading.code, log, names, **values)


@dataclass(frozen=True, eq=False)
class LoadModel:
    """The whitened torques of each joint, projected orthogonally to the columns of its drive."""

    # The c free parameters are factors of the URDF's links, and m, mcx, mcy, mcz of a payload.

    R: Array  # (n, c+1, c+1), triangular factors of columns and torque; 0 of joints not used
    mean: Array  # (c,), prior mean
    spread: Array  # (c,), prior standard deviation
    expected: float  # Misfit of torques that fit as well as with separate parameters for each joint
    independent: float  # Number of independent torques

    def misfit(self, scale: float | Array) -> float:
        """Return the misfit of torques times a scale, or (n,): chi-square, prior included."""
        return float(np.asarray(np.linalg.qr(self._rows(scale), mode="r"))[-1, -1] ** 2)

    def fit(self, scale: float = 1.0) -> tuple[float, Array, Array]:
        """Fit with the torque columns multiplied by a scale, without negative masses of links."""
        from scipy.optimize import lsq_linear

        rows = self._rows(scale)
        bounds = np.full(len(self.mean), -np.inf)
        bounds[:-4] = 0.0
        solution = lsq_linear(rows[:, :-1], rows[:, -1], bounds=(bounds, np.inf), method="bvls")
        inverse = np.linalg.inv(np.linalg.qr(rows[:, :-1], mode="r"))
        error: Array = self.spread * np.linalg.norm(inverse, axis=1)
        return 2 * float(solution.cost), self.spread * solution.x, error

    def is_this_robot(self, scale: float = 1.0) -> bool:
        """Return whether scaled torques fit well with masses of the links near the URDF's."""
        chi, theta, _ = self.fit(scale)
        is_good = chi - self.expected < _WORSE * self.independent
        return is_good and _error_of_links(theta) < _MISMATCH

    def _rows(self, scale: float | Array) -> Array:
        """Return the rows of torques and prior, columns times the spread, (N, c+1)."""
        c = len(self.mean)
        rows = self.R * np.append(self.spread, 1.0)
        rows[..., :-1] /= np.reshape(scale, (-1, 1, 1))
        prior = np.column_stack([np.eye(c), self.mean / self.spread])
        return np.concatenate([rows.reshape(-1, c + 1), prior])


def load_model(probe: Probe, share: Array, doubt: Array | float = 0.0) -> LoadModel:
    """Return the load model of a motion: shares of noise, and of errors that are no noise, (n,)."""
    (N, n), drives = probe.tau.shape, drive_columns(probe.model, probe.q, probe.v, probe.a)
    independent = min(_INDEPENDENT, _PER_SECOND * float(np.ptp(probe.motion.t[probe.rows])))
    bodies = probe.loads.shape[2]
    X = np.concatenate([probe.loads, probe.last_body, probe.tau[:, :, None]], axis=2)
    level = probe.tau.std(axis=0)
    used = (level > TINY * np.abs(probe.tau).max()) & (share < _UNEXPLAINED)
    R, variance = np.zeros((n, bodies + 5, bodies + 5)), decisions.AGREES**2 + share + doubt
    for j in np.flatnonzero(used).tolist():
        drive = drives[:, j]
        length = np.linalg.norm(drive, axis=0)
        U, s, _ = np.linalg.svd(drive / np.where(length > 0, length, 1.0), full_matrices=False)
        Q = U[:, s > TINY * s[0]]
        left = X[:, j] - Q @ (Q.T @ X[:, j])
        sigma = np.sqrt(variance[j]) * level[j]
        R[j] = np.linalg.qr(left * np.sqrt(independent / N) / sigma, mode="r")
    mean = np.append(np.ones(bodies), np.zeros(4))
    arm = _mass(probe.model)  # a payload is of its size
    spread = np.append(np.full(bodies, _SPREAD), [arm, *[arm * probe.model.length] * 3])
    expected = independent * float((share / variance)[used].sum())
    return LoadModel(R, mean, spread, expected, independent * float(used.sum()))


def _check_loads(probe: Probe, share: Array, name: str, is_explained: bool) -> Iterator[Finding]:
    """Yield torques in another scale, a payload, a URDF of another robot."""
    left = np.mean((probe.tau - probe.loads.sum(axis=2)) ** 2, axis=0)
    noise = share * probe.tau.var(axis=0) / decisions.BETTER
    if ((left < noise) & (share < EXPLAINED)).all():  # no drive has friction or an armature
        yield finding("model_torque", name)
        return
    # A common scale must fit with about the URDF's masses; else the URDF is of another robot.
    model = load_model(probe, share)
    _, theta, error = model.fit()
    is_this_robot = model.is_this_robot()
    if not is_this_robot and (what := _subtracted(probe, model)):
        yield finding("gravity_compensated", name, what=what)
    elif is_explained:
        # errors of the URDF's centres of mass are no other robot
        is_other = not load_model(probe, share + probe.uncertain).is_this_robot()
        scale = 1.0 if is_this_robot else _torque_scale(model)
        if scale != 1.0 and model.is_this_robot(scale):
            used = np.array(probe.model.joints)[model.R.any(axis=(1, 2))].tolist()
            is_unit = len(used) == len(share) and abs(np.log(scale)) > np.log(_OTHER_UNIT)
            yield finding(
                "current_for_torque", name, used if len(used) < len(share) else (), also=False,
                joints=len(used), severity="error" if is_unit else "warning", factor=scale,
                joint=listed(used),
            )  # fmt: skip
        elif is_other or _error_of_links(theta) > _MISMATCH:
            factors = dict(zip(probe.model.layout.bodies, theta[:-4].tolist(), strict=True))
            words = ", ".join(f"{link} {factor:.2g}" for link, factor in factors.items())
            mismatch = finding("urdf_mismatch", name, factors=words, **factors)
            yield from _reread(probe, share, name) or [mismatch] * is_other
        else:
            yield from _payload(probe, theta[-4:], float(error[-4]), name)


def _subtracted(probe: Probe, model: LoadModel) -> str:
    """Return what of the URDF's torque is missing, with which the torques fit the URDF's masses."""
    weight = replace(probe, v=0.0 * probe.v, a=0.0 * probe.a).loads.sum(axis=2)
    check = TorqueCheck.of(replace(probe, tau=probe.tau + weight))
    whole, urdf = load_model(check.probe, check.share), np.append(model.mean, -1.0)
    chi, theta, _ = whole.fit()
    before, after = (np.sum((x.R @ urdf) ** 2, axis=1) for x in (model, whole))
    agree = (after <= decisions.TENFOLD * before).all()  # no joint contradicts it
    if agree and _error_of_links(theta) < _MISMATCH and chi < decisions.BETTER * model.misfit(1.0):
        return "robot"
    R, rows = model.R.copy(), np.arange(len(model.R))
    R[..., -1] += R[..., :-5].sum(axis=-1)  # the torque of all links
    added = replace(model, R=R)
    # a small torque fits in another scale, too: of bodies beside which friction is not most of it
    bare = Samples.of(probe, rows, rows >= 0).changed(gravity=0.0 * rows, inertia=0.0 * rows)
    is_clear = model.misfit(_torque_scale(model)) - added.misfit(1.0) > SIGNIFICANT**2
    is_clear |= bool((bare.share < 1.0 - decisions.MOST).all())
    return "model" if is_clear and added.is_this_robot() else ""


def _reread(probe: Probe, share: Array, log: str) -> list[Finding]:
    """Return another clock or zeros with which the URDF's masses fit the torques, if there are."""
    from scipy.optimize import minimize_scalar

    joints, most = np.array(probe.model.joints), float(np.log(decisions.TENFOLD))
    doubt = probe.uncertain  # errors of centres of mass look like zeros

    def read(x: float, joint: str, every: int = 1) -> Probe:
        m, speed = probe.motion, 1.0 if joint else float(np.exp(x))
        m = replace(m, q=m.q - x * (joints == joint), v=speed * m.v, a=speed**2 * m.a)
        return Probe.of(probe.model, m, probe.rows[::every])

    def misfit(x: float, joint: str) -> float:
        return load_model(read(x, joint, _THINNED), share, doubt).misfit(1.0)

    turning = [x for x in joints.tolist() if x not in probe.model.layout.prismatic]
    starts = [(joint, x, readings.OFFSET) for joint in turning for x in readings.QUARTERS]
    tried = [
        (minimize_scalar(misfit, None, (x - far, x + far), joint, options=_NEAR), joint)
        for joint, x, far in [("", 0.0, most), *starts]
    ]
    best, joint = min(tried, key=lambda x: x[0].fun)
    if misfit(0.0, "") - best.fun < SIGNIFICANT**2:
        return []
    after, code = read(best.x, joint), "position_offset" if joint else "time_scale"
    if not joint and best.x < -np.log(NO_ERROR_OF_MASSES):  # nine times less inertia, or none
        code = "static_torque"
    values: dict[str, float | str] = {"what": "log", "cure": "masses", "also": False}
    values |= {"offset": best.x} if joint else {"speed": np.exp(-best.x)}
    one = finding(code, log, (joint,) * bool(joint), severity="warning", **values)
    is_robot = load_model(after, share, doubt / decisions.TENFOLD).is_this_robot()
    rest = [] if is_robot else _reread(after, share, log)
    return [one, *rest] if is_robot or rest else []


def _error_of_links(theta: Array) -> float:
    return float(np.sum(((theta[:-4] - 1.0) / _SPREAD) ** 2))


def _torque_scale(model: LoadModel) -> float:
    """Return the best common factor beyond errors of masses."""
    far = _SCALES[np.abs(np.log(_SCALES)) > np.log(NO_ERROR_OF_MASSES)]
    return float(min(far, key=model.misfit))


def _payload(probe: Probe, load: Array, error: float, name: str) -> Iterator[Finding]:
    mass = float(load[0])
    if abs(mass) < BEYOND_NOISE * error:
        return
    link = probe.model.layout.bodies[-1]
    yield finding(
        "payload", name, subject=link, link=link, sense=mass > 0, cure=mass > 0,
        severity="warning" if abs(mass) - 2 * error > _LARGE * _mass(probe.model) else "note",
        mass=mass, std_error=error, mcx=load[1], mcy=load[2], mcz=load[3],
    )  # fmt: skip


def _mass(model: RobotModel) -> float:
    return float(model.standard_parameters()[: model.layout.n_inertial : 10].sum())
