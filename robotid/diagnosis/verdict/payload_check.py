"""A payload of known mass as a check of the torque scale."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from robotid.diagnosis.verdict.stated_mass import AGREES


@dataclass(frozen=True)
class PayloadCheck:
    """The known mass of a payload, and its mass as torque alone determines it.

    Attributes:
        link: The link that carries it.
        known: Its known mass [kg].
        identified: Its mass identified without this knowledge [kg]; None if the motion does not
            determine it.
        std_error: Standard error of that [kg].
        interval: 95 % interval of it [kg].
        log: The log with the payload; "" if it is not a file.
        sha256: SHA-256 of the log; "" if it is not a file.
    """

    link: str
    known: float
    identified: float | None = None
    std_error: float = 0.0
    interval: tuple[float, float] = (0.0, 0.0)
    log: str = ""
    sha256: str = ""

    @property
    def ratio(self) -> float | None:
        """Identified over known mass, the scale of the torques [-]."""
        return None if self.identified is None else self.identified / self.known

    @property
    def verifies(self) -> bool:
        """Whether the masses differ by at most 5 %, and the half-width of the interval is so, too.

        A stated mass of the robot verifies the scale by the same criterion.
        """
        low, high = self.interval
        is_sharp = 0.5 * (high - low) <= AGREES * self.known
        return self.ratio is not None and abs(self.ratio - 1.0) <= AGREES and is_sharp

    @property
    def contradicts(self) -> bool:
        """Whether the masses differ by more than 5 %, and the known one is outside the interval."""
        low, high = self.interval
        is_outside = not low <= self.known <= high
        return self.ratio is not None and abs(self.ratio - 1.0) > AGREES and is_outside

    @property
    def message(self) -> str:
        """Both masses, their difference, and what follows for the scale of the torques."""
        what, ratio = f"payload of {self.known:g} kg on {self.link}", self.ratio
        if self.identified is None or ratio is None:
            return (
                f"{what}: the motion does not determine its mass, which does not verify the scale; "
                "record poses and motions in which its gravity loads different joints"
            )
        low, high = self.interval
        deviation = (
            f", {abs(self.identified - self.known) / self.std_error:.1f} standard errors"
            if self.std_error > 0
            else ""
        )
        found = (
            f"{what}: torque alone determines {self.identified:.4g} kg (95 % interval {low:.4g} to "
            f"{high:.4g}), {100 * (ratio - 1):+.1f} %{deviation}"
        )
        limit = f"{100 * AGREES:g} %"
        if self.verifies:
            return f"{found}; wanted: at most {limit}"
        if self.contradicts:
            size = f"{100 * abs(ratio - 1):.0f} % too {'large' if ratio > 1 else 'small'}"
            return (
                f"{found}; wanted: at most {limit}. The torques of the joints that carry it are "
                f"about {size}, and so are masses and inertias: divide the gains of the torques by "
                f"{ratio:.3g}, or check the known mass"
            )
        return (
            f"{found}. This neither verifies nor contradicts the scale; wanted: a difference and a "
            f"half-width of the interval of at most {limit}. Use a larger payload, or a longer "
            "motion"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as result.json has them."""
        return asdict(self) | {"interval": list(self.interval), "message": self.message}

    @classmethod
    def from_dict(cls, stated: Mapping[str, Any]) -> PayloadCheck:
        """Return the check that a result.json has."""
        own = {key: value for key, value in stated.items() if key != "message"}
        low, high = stated["interval"]
        return cls(**own | {"interval": (low, high)})
