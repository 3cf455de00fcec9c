"""Saved policies: what is loaded chooses as what was saved."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cfx.data.pairs import PairBatch
from cfx.errors import DataError
from cfx.models.krauss import Krauss
from cfx.policies import checkpoint
from cfx.policies.agent import Agent, TrainedOn
from cfx.policies.context import ContextRule, DriverContext
from cfx.policies.history import measured_history
from tests.agents import adaptive
from tests.drives import wavy_pairs

NODE = {"name": "krauss"}


def chosen(agent: Agent) -> torch.Tensor:
    """Returns what an agent chooses for two drivers after a burn-in, `(2, n)`."""
    true = torch.tensor([[1.5, 0.1], [2.5, 0.4]], dtype=torch.float64)
    batch = PairBatch.of(wavy_pairs(Krauss(), true, frames=120))
    until = torch.tensor([60, 80])
    base = true if agent.core.head.needs_base else None
    state = agent.begin(torch.zeros(2, dtype=torch.int64), DriverContext(base))
    state = agent.burn_in(batch, until, state)
    now = measured_history(batch, torch.arange(2), until, agent.windows.length)
    return agent.act(now, state)[0]


@pytest.mark.parametrize("head", ["direct", "offset", "residual"])
def test_a_loaded_agent_chooses_what_the_saved_one_chose(tmp_path: Path, head: str) -> None:
    made = adaptive(NODE, ("p1", "all"), offsets=head == "offset", residual=head == "residual")
    agent = replace(
        made,
        context_rule=ContextRule(driver_specific=False, shrinkage=0.3, history_s=20.0),
        trained_on=TrainedOn({"abc": "a/1"}),
    )
    checkpoint.save_agent(agent, tmp_path)
    loaded = checkpoint.load_agent(tmp_path)
    assert torch.equal(chosen(loaded), chosen(agent))
    assert loaded.context_rule == agent.context_rule
    assert loaded.trained_on == agent.trained_on
    assert loaded.names == agent.names
    description = json.loads((tmp_path / "policy.json").read_text())
    assert description["head"] == head


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", 2, "has format 2; this version of cfx reads format 3"),
        (
            "head",
            "mixture",
            "this version of cfx has no head 'mixture'; it has direct, direct_residual, ",
        ),
        ("head", "offset", "the weights read 25 features, the policy's settings give 27"),
    ],
)
def test_what_cannot_be_read_is_refused(
    tmp_path: Path, key: str, value: object, message: str
) -> None:
    checkpoint.save_agent(adaptive(NODE), tmp_path)
    description = json.loads((tmp_path / "policy.json").read_text())
    (tmp_path / "policy.json").write_text(json.dumps(description | {key: value}))
    with pytest.raises(DataError, match=message):
        checkpoint.load_agent(tmp_path)


def test_a_folder_without_a_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no policy that can be read"):
        checkpoint.load_agent(tmp_path)
