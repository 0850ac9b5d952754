"""What runs: the versions that a result depends on."""

import platform
from importlib.metadata import PackageNotFoundError, version

__all__ = ["__version__", "versions"]

__version__ = "0.1.0"

_PACKAGES = {"pinocchio": "pin", "numpy": "numpy", "scipy": "scipy", "clarabel": "clarabel"}


def versions() -> dict[str, str]:
    """Return the versions of this package, of what it computes with, of Python and the platform.

    Returns:
        Versions by name; "not installed by pip" where no package of that name is recorded.
    """
    found = {"robotid": __version__}
    for name, package in _PACKAGES.items():
        try:
            found[name] = version(package)
        except PackageNotFoundError:
            found[name] = "not installed by pip"
    return found | {"python": platform.python_version(), "platform": platform.platform()}
