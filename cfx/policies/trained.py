"""Where saved policies were loaded before `cfx.agents` took them: for one version more.

Policies that MLflow logged with the version before carry code that imports `TrainedPolicy` from
here.
"""

from __future__ import annotations

import warnings
from importlib import import_module
from pathlib import Path
from typing import Any


class TrainedPolicy:
    """Loads saved policies; `cfx.agents.checkpoint.load` does it now."""

    @staticmethod
    def load(folder: Path | str) -> Any:
        """Returns the `cfx.agents.agent.Agent` in a folder."""
        warnings.warn(
            "cfx.policies.trained is now cfx.agents; this module goes with the next version",
            DeprecationWarning,
            stacklevel=2,
        )
        # By name: a policy's module stands below the agents and must not import them.
        return import_module("cfx.agents.checkpoint").load(folder)
