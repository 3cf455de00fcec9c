"""When two commands are the same sweep, and two jobs the same job: hashes of what was asked for.

Importing this module makes `${cfx_job:}` known to OmegaConf.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from cfx.component import content_key


def fingerprint(values: Mapping[str, Any]) -> str:
    """Returns a hash of what a job's results depend on: configuration, versions of cfx and of plugins, state of the data file.

    Args:
        values: the job's resolved configuration.

    Raises:
        PluginError: a component that is named is not there.
    """
    from cfx.tracking import provenance

    node = values.get("data")
    path = node.get("path") if isinstance(node, Mapping) else None
    state = None
    if path:
        with contextlib.suppress(
            OSError
        ):  # a file that is not there is the dataset's to complain about
            found = Path(str(path)).expanduser().stat()
            state = [found.st_size, found.st_mtime_ns]
    parts = {
        "config": values,
        "cfx": provenance.version(),
        "plugins": {
            **provenance.distributions(values),
            **provenance.metric_distributions(values),
        },
        "data": state,
    }
    return content_key(parts)


def job_name(_root_: Any) -> str:
    """Returns the end of a job folder's name, the same for the same overrides in any order: `${cfx_job:}` in Hydra's config."""
    task: Any = OmegaConf.to_container(_root_.hydra.overrides.task, resolve=False)
    given = {
        one.partition("=")[0]: one for one in task
    }  # where a key is given twice the last one counts
    return content_key([sorted(given.values()), *_sources(_root_)])[:8]


def command_of(config: DictConfig) -> tuple[tuple[str, ...], str, int | None]:
    """Returns what was asked for: as typed, as a hash that knows no order, and how many jobs that makes.

    Of Hydra's own overrides only those of the sweeper count: the same sweep may go on with another launcher.
    """
    typed: Any = OmegaConf.to_container(config.hydra.overrides, resolve=False)
    sweeper: Any = OmegaConf.to_container(config.hydra.sweeper, resolve=False)
    asked = [
        f"{key}={value}" for key, value in (sweeper.pop("params", None) or {}).items()
    ] + typed["task"]
    values: dict[str, list[str]] = {}
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    for override in parser.parse_overrides(asked):
        key = override.get_key_element()
        if override.is_discrete_sweep():
            values[key] = sorted(override.sweep_string_iterator())
        else:
            values[key] = [str(override.input_line)]
    basic = str(sweeper.get("_target_", "")).endswith(".BasicSweeper")
    jobs = math.prod(len(set(one)) for one in values.values()) if basic else None
    return (
        (*typed["task"], *typed["hydra"]),
        content_key([values, sweeper, *_sources(config)]),
        jobs,
    )


def _sources(config: Any) -> tuple[Any, ...]:
    """Returns what else on the command line decides what the overrides mean: --config-name and --config-dir."""
    given = [
        str(source.path)
        for source in config.hydra.runtime.config_sources
        if source.provider == "command-line"
    ]
    return str(config.hydra.job.config_name), given


OmegaConf.register_new_resolver("cfx_job", job_name, replace=True)
