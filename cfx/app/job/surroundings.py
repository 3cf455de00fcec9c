"""Further signals, which inputs of policies read beyond those of every recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.data.signals import declared_by, further_signals
from cfx.errors import DataError
from cfx.results.config import JobConfig

if TYPE_CHECKING:
    from cfx.data.pairs import PairSet
    from cfx.policies.base import Policy


def with_signals_of_inputs(config: JobConfig) -> JobConfig:
    """Returns the configuration whose dataset reads the further signals of the policy's inputs.

    Only datasets that can read them have a setting `inputs`. Names that are no inputs are left to
    the policy, which refuses them.

    Raises:
        PluginError: an input cannot be loaded.
    """
    chosen = config.policy.get("inputs")
    dataset = config.data.get("name")
    if not isinstance(chosen, list | tuple) or dataset not in registry.names("dataset"):
        return config
    if "inputs" not in registry.get("dataset", dataset).schema.model_fields:
        return config
    configured = list(config.data.get("inputs") or ())
    missing = []
    for name in chosen:
        if name in configured or name not in registry.names("input"):
            continue
        # cfx's own inputs read the signals of every recording; their code is heavy to import.
        is_own = registry.entry("input", name).distribution == OWN
        if not is_own and further_signals(declared_by(name)):
            missing.append(name)
    if not missing:
        return config
    data = {**config.data, "inputs": [*configured, *missing]}
    return JobConfig.of({**config.model_dump(), "data": data})


def require_signals(policy: Policy, pairs: PairSet) -> None:
    """Checks that pairs have the signals that a policy's inputs read.

    Raises:
        DataError: they lack one.
    """
    recorded = set(pairs.surroundings)
    for name in policy.inputs:
        for signal in further_signals(declared_by(name)):
            if signal not in recorded:
                raise DataError(
                    f"{pairs.source}: the policy's input '{name}' reads the signal '{signal.name}',"
                    f" which these pairs do not have; read a recording with a column"
                    f" {signal.column} by data=tidy data.inputs=[{name}], or leave '{name}' out of"
                    " policy.inputs"
                )
