"""Sweeps that can be broken off and started again.

A sweep is a Hydra multirun. Its folder holds `sweep.json` (which command it belongs to), a folder
per job, named by the job's overrides so that the same job always finds its own, and `summary.csv`.
The marker of a job is `outcome.json`, written whole and last: a job whose marker says that it ended
well with the same configuration, versions and data is not run again.
"""

from __future__ import annotations

from cfx.app.sweep.folder import fingerprint, only_one
from cfx.app.sweep.record import RECORD, STATUS, JobStatus, Record, metrics_of
from cfx.app.sweep.running import Refused, Sweep, SweepFolder, worker_of
from cfx.app.sweep.summary import SUMMARY

__all__ = [
    "RECORD",
    "STATUS",
    "SUMMARY",
    "JobStatus",
    "Record",
    "Refused",
    "Sweep",
    "SweepFolder",
    "fingerprint",
    "metrics_of",
    "only_one",
    "worker_of",
]
