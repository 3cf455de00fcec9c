"""Memory that the data of a training needs: `python -m tests.benchmarks.training_memory 30000`.

Copies of six drivers, 300 frames each, are placed for two networks; then one of them is taken, as
a part of the training would. What this needs beyond the recordings is printed.
"""

from __future__ import annotations

import resource
import sys
from dataclasses import replace

import torch

from cfx.learners.rollout.dataset import RolloutDataset
from cfx.learners.rollout.settings import RolloutSettings
from cfx.policies.gru import GruPolicy
from cfx.policies.heads import head_class
from tests.learners.made import training_data


def main(count: int) -> None:
    """Prints how many MB `count` pairs take at most."""
    data = training_data(networks=1, frames=300)
    copies = torch.arange(len(data.pairs)).repeat(-(-count // len(data.pairs)))[:count]
    generator = torch.Generator().manual_seed(0)
    spread = torch.rand((count, 1), dtype=torch.float64, generator=generator)
    pairs = replace(
        data.pairs,
        index=torch.arange(count),
        split=data.pairs.split[copies],
        network=torch.zeros(count, dtype=torch.int64),
        fixed=data.pairs.start[copies] + 0.01 * spread,
        drivers=tuple(str(number) for number in range(count)),
    )
    data = replace(data, recorded=data.recorded[copies], pairs=pairs, names=("all",))
    head = head_class("offset").for_model(data.stepper.model)
    before = _most()
    settings = RolloutSettings(ensemble_size=2)
    dataset = RolloutDataset.of(data, GruPolicy(inputs="situation"), head, settings, generator)
    dataset.only(slice(0, 1))
    print(f"{count} pairs: {before:.0f} MB before, at most {_most() - before:.0f} MB more")


def _most() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main(int(sys.argv[1]))
