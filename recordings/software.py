"""Versions of what takes part in a recording or a result."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache
def software_versions(*packages: str) -> dict[str, str]:
    """Version of Python and of each package; "absent" where it is not installed as a package."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found
