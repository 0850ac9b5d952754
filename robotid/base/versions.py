"""The versions of the software that a result depends on."""

from functools import cache

__version__ = "0.2.0"

_PACKAGES = {"pinocchio": "pin", "numpy": "numpy", "scipy": "scipy", "numba": "numba"}


def code_versions() -> dict[str, str]:
    """Return the versions that determine results to the last bit."""
    import platform  # only results state versions

    found = {name: _installed(package) for name, package in _PACKAGES.items()}
    return {"robotid": __version__, **found, "python": platform.python_version()}


def versions() -> dict[str, str]:
    """Return all versions: ``code_versions`` and the platform."""
    import platform

    return code_versions() | {"platform": platform.platform()}


@cache  # each call reads the metadata of a package
def _installed(package: str) -> str:
    from importlib.metadata import PackageNotFoundError, version  # only results state versions

    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed by pip"
