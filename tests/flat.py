"""A job with a parameter that no recording determines, as a fixture."""

from __future__ import annotations

from pathlib import Path

import pytest

JOB = [
    "debug=quick",
    "data.pairs=3",
    "data.platoon_size=1",
    "data.frames=150",
    "data.max_pairs=null",
    "figures=none",
    "model=w99",
    "model.parameters.b.tuned=true",
    "policy=fixed",
    "calibration.prior=weak",
]
"""W99's deceleration b has no effect below its brake cap, 9 m/s2, so that its loss is flat for
every driver where a job tunes it."""


@pytest.fixture(scope="session")
def flat_job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the job."""
    import cfx

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("flat"))
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        folder = cfx.run([*JOB, "tracking.enabled=false"]).folder
    assert folder is not None
    return folder
