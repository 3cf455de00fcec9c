"""Whether SUMO is installed, by metadata alone.

libsumo is never imported into a job's process.
"""

from __future__ import annotations

import importlib.metadata
import re

from cfx.errors import NotInstalledError, SumoError
from cfx.plugin import distributions

DISTRIBUTION = "cfx-sumo"
"""What brings SUMO."""

OLDEST, BELOW = (1, 28), (2, 0)
"""Versions that cfx works with, as pyproject.toml asks for them."""


def require_sumo() -> str:
    """Returns the version of the libsumo that is installed.

    Raises:
        NotInstalledError: it is not; says what to install.
        SumoError: its version is not one that cfx works with.
    """
    wanted = f"SUMO {_text(OLDEST)} or newer, below {BELOW[0]}"
    try:
        version = importlib.metadata.version("libsumo")
    except importlib.metadata.PackageNotFoundError:
        line = distributions.install_line(DISTRIBUTION)
        raise NotInstalledError(f"SUMO is not installed; {wanted}, comes with: {line}") from None
    number = re.match(r"(\d+)\.(\d+)", version)
    if number is None or not OLDEST <= (int(number[1]), int(number[2])) < BELOW:
        raise SumoError(
            f"SUMO {version} is installed (the package libsumo), but cfx works with {wanted}:"
            f" {distributions.install_line(DISTRIBUTION)}"
        )
    return version


def _text(version: tuple[int, int]) -> str:
    return f"{version[0]}.{version[1]}"
