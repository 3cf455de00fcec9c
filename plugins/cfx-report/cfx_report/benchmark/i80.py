"""The suite `i80`: the first frozen protocol, of one recording."""

from __future__ import annotations

from cfx_report.benchmark.frozen import DATA, DATA_NAME, OVERRIDES, VERSION, protocol_hash
from cfx_report.benchmark.suite import Scheme, Site, Suite, Task


class _OneRecording(Suite):
    """A suite whose hash is older than suites are."""

    def protocol_of(self, fingerprint: str) -> str:
        return f"{VERSION}/{protocol_hash(fingerprint)}"


I80 = _OneRecording(
    name="i80",
    version=VERSION,
    files=("i80_reconstructed_pairs.parquet",),
    sites=(Site("I-80", "", ""),),
    schemes=(Scheme("drivers", "driver", 5),),
    tasks=(Task("unseen", "unseen drivers, full trajectories", "drivers", "full"),),
    fingerprint=DATA,
    about=DATA_NAME,
    longest=1_000_000,  # all pairs of a driver
    min_test_duration=70,
    job=OVERRIDES,
)
"""The protocol as a suite."""
