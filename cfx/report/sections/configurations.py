"""The whole configuration of each job."""

from __future__ import annotations

from collections.abc import Mapping

import yaml

from cfx.report.blocks import Block, Fold, Listing, Text
from cfx.report.files import without_folders
from cfx.report.job import Job, Runs
from cfx.report.section import Section


class ConfigurationsSection(Section):
    """The whole configuration of each job."""

    title = "Configurations"
    entry = "Configurations"
    order = 2000

    def blocks(self, runs: Runs) -> list[Block]:
        """Return a fold for each job."""
        found: list[Block] = [Text("The whole configuration of each job, as it ran.")]
        for job in runs.jobs:
            found.append(
                Fold(
                    job.name,
                    (Text(without_folders(job.place), "fine"), Listing(_configuration(job))),
                )
            )
        return found


def _configuration(job: Job) -> str:
    """Returns the configuration as YAML, after what the protocol noted of its design."""
    design = ""
    notes = job.data.get("protocol")
    if isinstance(notes, Mapping):
        for name, value in notes.items():
            design += f"# {str(name).replace('_', ' ')}: {value}\n"
    text = yaml.safe_dump(dict(job.config), sort_keys=False, allow_unicode=True)
    return design + without_folders(str(text))
