"""The parameters that an agent chooses for the end of recorded pairs, as a table."""

from __future__ import annotations

import pandas as pd
import torch
from torch import Tensor

from cfx.data.pairs import PairBatch, PairSet
from cfx.data.tidy import pairs_from_frame
from cfx.errors import DataError
from cfx.policies.agent import Agent
from cfx.policies.context import DriverContext
from cfx.policies.core import ANY_DRIVER
from cfx.policies.history import measured_history
from cfx.policies.known_drivers import driver_features_of


def predict_frame(agent: Agent, frame: pd.DataFrame) -> pd.DataFrame:
    """Chooses parameters for the end of each pair in a tidy table.

    Args:
        agent: that chooses them.
        frame: measured history in the tidy pair layout, one or more pairs with the agent's time
            step.

    Returns:
        A row per pair: `pair_id` and one column per tuned parameter (SI units), for the window
        that starts at the pair's last frame. A pair that the agent was trained for is driven by
        its own network; any other by the only network there is, or the one named `all`.

    Raises:
        DataError: the table is not in the tidy layout, its time step is another, or it is not
            clear which network to use.
    """
    source = "the table given to the policy"
    pairs = pairs_from_frame(frame, source, signals=agent.core.further_signals)
    if abs(pairs.dt - agent.dt) > 1e-6:
        raise DataError(
            f"the policy was trained at time steps of {agent.dt:g} s, the table has"
            f" {pairs.dt:g} s; resample the table"
        )
    batch = PairBatch.of(pairs)
    until = batch.lengths - 1
    context = DriverContext(driver_features=driver_features_of(agent, batch, until))
    state = agent.burn_in(batch, until, agent.begin(networks_for(agent, pairs), context))
    everyone = torch.arange(len(batch))
    now = measured_history(batch, everyone, until, agent.windows.length)
    chosen, _ = agent.act(now, state)
    table = pd.DataFrame(chosen.tolist(), columns=list(agent.space.names))
    table.insert(0, "pair_id", pairs.ids)
    return table


def networks_for(agent: Agent, pairs: PairSet) -> Tensor:
    """Returns which network drives each pair, `(P,)`.

    Raises:
        DataError: a pair is none of those that the networks were trained for, and no network is
            for any driver.
    """
    if len(agent.names) == 1:
        return torch.zeros(len(pairs), dtype=torch.int64)
    numbers = []
    for pair in pairs:
        if pair.pair_id in agent.names:
            numbers.append(agent.names.index(pair.pair_id))
        elif ANY_DRIVER in agent.names:
            numbers.append(agent.names.index(ANY_DRIVER))
        else:
            raise DataError(
                f"pair '{pair.pair_id}' has no network of its own among the {len(agent.names)}"
                " that were trained, one per pair; train with protocol.networks=all or"
                " protocol=across_drivers to drive others"
            )
    return torch.tensor(numbers)
