"""The versions that a file names, of what made it."""

import importlib.metadata

import hgail_jax


def installed(*packages: str) -> dict[str, str | None]:
    """Returns the version of each distribution, None where it is not installed; this one may be a bare checkout.

    >>> installed("no-such-package")
    {'no-such-package': None}
    """
    return {package: _version(package) for package in packages}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return hgail_jax.__version__ if package == "hgail-jax" else None
