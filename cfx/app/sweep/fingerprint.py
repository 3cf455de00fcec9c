"""When two commands are the same sweep, and two jobs the same job: hashes of what was asked for.

Importing this module makes `${cfx_job:}` known to OmegaConf.
"""

from __future__ import annotations

import contextlib
import glob
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from cfx.core.component import content_key
from cfx.core.errors import CfxError
from cfx.core.storage import is_url, state


def fingerprint(values: Mapping[str, Any]) -> str:
    """Returns a hash of what a job's results depend on.

    It covers the configuration, the versions of cfx and of plugins, and the state of the data file.

    Args:
        values: the job's resolved configuration.

    Raises:
        PluginError: a component that is named is not there.
    """
    from cfx.results import provenance

    parts = {
        "config": values,
        "cfx": provenance.version(),
        "plugins": {
            **provenance.distributions(values),
            **provenance.metric_distributions(values),
        },
        "data": _state_of_data(values.get("data")),
    }
    return content_key(parts)


def job_name(_root_: Any) -> str:
    """Returns the end of a job folder's name: `${cfx_job:}` in Hydra's configuration.

    It is the same for the same overrides in any order.
    """
    task: Any = OmegaConf.to_container(_root_.hydra.overrides.task, resolve=False)
    given = {}
    for override in task:
        key = override.partition("=")[0]
        given[key] = override  # where a key is given twice the last one counts
    return content_key([sorted(given.values()), *_sources(_root_)])[:8]


def command_of(config: DictConfig) -> tuple[tuple[str, ...], str, int | None]:
    """Returns the command of a sweep: as typed, as a hash, and how many jobs it makes.

    The hash knows no order. Of Hydra's own overrides only those of the sweeper count: the same
    sweep may go on with another launcher. The number of jobs is None if the sweeper decides as it
    goes.
    """
    typed: Any = OmegaConf.to_container(config.hydra.overrides, resolve=False)
    sweeper: Any = OmegaConf.to_container(config.hydra.sweeper, resolve=False)
    asked = []
    for key, value in (sweeper.pop("params", None) or {}).items():
        asked.append(f"{key}={value}")
    asked += typed["task"]

    values: dict[str, list[str]] = {}
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    for override in parser.parse_overrides(asked):
        key = override.get_key_element()
        if override.is_discrete_sweep():
            values[key] = sorted(override.sweep_string_iterator())
        else:
            values[key] = [str(override.input_line)]

    jobs = None
    if str(sweeper.get("_target_", "")).endswith(".BasicSweeper"):
        jobs = math.prod(len(set(options)) for options in values.values())
    command = (*typed["task"], *typed["hydra"])
    return command, content_key([values, sweeper, *_sources(config)]), jobs


def _state_of_data(node: Any) -> list[list[Any]] | None:
    """Returns size and time of change (ns) of each data file; None if the dataset names none.

    A folder stands for the parquet files in it. Of files behind a URL it is what their store says
    that they are.
    """
    if not isinstance(node, Mapping) or not node.get("path"):
        return None
    from cfx.data.files import partitions

    named = node["path"]
    patterns = named if isinstance(named, list | tuple) else [named]
    states: list[list[Any]] = []
    for pattern in patterns:
        if is_url(pattern):
            with contextlib.suppress(CfxError):
                states.append(state(pattern))
            continue
        path = Path(str(pattern)).expanduser()
        files = [str(path)] if path.exists() else sorted(glob.glob(str(path)))  # noqa: PTH207 - the pattern may be absolute, Path.glob takes none
        for file in files:
            # The dataset complains about a file that is gone, and about a folder without any.
            with contextlib.suppress(OSError, CfxError):
                for part in partitions(Path(file)):
                    found = part.stat()
                    states.append([found.st_size, found.st_mtime_ns])
    return states


def _sources(config: Any) -> tuple[Any, ...]:
    """Returns what else decides what the overrides mean: --config-name and --config-dir."""
    given = []
    for source in config.hydra.runtime.config_sources:
        if source.provider == "command-line":
            given.append(str(source.path))
    return str(config.hydra.job.config_name), given


OmegaConf.register_new_resolver("cfx_job", job_name, replace=True)
