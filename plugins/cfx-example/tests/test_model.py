"""The contract of a driving model, and what this one adds to it."""

import cfx
import torch
from cfx.plugin import Leader, Start, simulate_follower
from cfx_contracts import check_contract

from cfx_example.model import Helly


def test_contract():
    check_contract(Helly(), equilibrium=lambda speed, p: p["d"] + p["t_gap"] * speed)


def test_cfx_finds_it():
    found = cfx.get("model", "helly")
    assert found is Helly, "install it first: pip install --editable ."


def test_it_settles_at_its_time_gap():
    time = torch.arange(1200) * 0.1
    leader = Leader(
        100.0 + 20.0 * time, torch.full_like(time, 20.0), torch.zeros_like(time), torch.tensor(5.0)
    )
    start = Start(torch.tensor(30.0), torch.tensor(20.0), torch.tensor(0.0))
    drive = simulate_follower(Helly(), {"t_gap": 1.5}, leader, start, 0.1)
    torch.testing.assert_close(drive.gap[-1], torch.tensor(2.5 + 1.5 * 20.0), atol=0.1, rtol=0.0)
