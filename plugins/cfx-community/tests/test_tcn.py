from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from torch import Tensor, nn

import cfx
from cfx_community.policies.tcn import TcnNetwork, TcnPolicy, TcnSettings
from cfx_contracts import check_contract


@pytest.mark.parametrize(
    "options",
    [
        {"channels": 6, "levels": 1, "kernel": 4},
        {"channels": 10, "levels": 2, "kernel": 2, "start": "middle"},
        # Tokens as wide as its channels: nothing stands in the way around a block.
        {"channels": 4, "inputs": ("gap", "relative_speed"), "summary": "mean_std", "dropout": 0.2},
    ],
)
def test_contract(options: dict[str, Any]) -> None:
    check_contract(TcnPolicy(**options))


def build(seed: int = 0, networks: int = 2, **options: object) -> TcnNetwork:
    network = TcnPolicy(**options).build(
        5,
        torch.full((3,), 0.5),
        torch.full((networks, 3), 0.25),
        torch.Generator().manual_seed(seed),
    )
    assert isinstance(network, TcnNetwork)
    return network.double().eval()


def noise(*shape: int) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def torch_block(block: nn.Module, network: int, x: Tensor) -> Tensor:
    """Returns what torch's convolutions make of `(B, inputs, W)`, left-padded with zeros."""

    def convolve(layer: nn.Module, x: Tensor) -> Tensor:
        weight = layer.weight[network].unflatten(0, (layer.kernel, layer.inputs)).permute(2, 1, 0)
        return nn.functional.conv1d(
            nn.functional.pad(x, (layer.memory, 0)),
            weight,
            layer.bias[network, 0],
            dilation=layer.dilation,
        )

    y = convolve(block.second, convolve(block.first, x).relu()).relu()
    return (y + (x if block.around is None else convolve(block.around, x))).relu()


def test_its_convolutions_are_torchs() -> None:
    network = build(start="middle", levels=3, channels=7)
    tokens = noise(2, 4, 20, 5)
    ours, _ = network(tokens, network.initial_state(2, 4))
    for i in range(2):
        x = tokens[i].transpose(1, 2)
        for block in network.blocks:
            x = torch_block(block, i, x)
        expected = (x.transpose(1, 2) @ network.w_out[i] + network.b_out[i]).sigmoid()
        torch.testing.assert_close(ours[i], expected)


@pytest.mark.parametrize(("levels", "kernel"), [(1, 2), (3, 3), (2, 5)])
def test_it_sees_as_far_back_as_it_says(levels: int, kernel: int) -> None:
    network = build(networks=1, start="middle", levels=levels, kernel=kernel)
    far = TcnSettings(levels=levels, kernel=kernel).receptive_field
    tokens = noise(1, 1, far + 3, 5).requires_grad_()
    out, _ = network(tokens, network.initial_state(1, 1))
    seen = torch.autograd.grad(out[0, 0, -1].sum(), tokens)[0][0, 0].abs().sum(-1) > 0
    assert seen[-far].item()
    assert not seen[:-far].any().item()


def test_an_untrained_network_is_the_fixed_model() -> None:
    fixed = torch.tensor([[0.1, 0.5], [0.9, 0.0]])
    network = TcnPolicy().build(4, torch.full((2,), 0.5), fixed, torch.Generator().manual_seed(0))
    out, _ = network(torch.randn((2, 3, 5, 4)), network.initial_state(2, 3))
    torch.testing.assert_close(out, fixed.clamp(0.02, 0.98)[:, None, None].expand_as(out))


def test_it_learns_what_happened_some_windows_ago() -> None:
    """Each of two networks learns what a signal was three, or six, windows before."""
    signal = torch.rand((2, 8, 60, 1), generator=torch.Generator().manual_seed(2))
    answer = torch.stack([signal[0].roll(3, dims=1), signal[1].roll(6, dims=1)])
    network = TcnPolicy(channels=8, levels=2).build(
        1, torch.full((1,), 0.5), torch.full((2, 1), 0.5), torch.Generator().manual_seed(0)
    )
    adam = torch.optim.Adam(network.parameters(), lr=0.01)
    for _ in range(250):
        out, _ = network(signal, network.initial_state(2, 8))
        loss = (out - answer)[:, :, 6:].square().mean((1, 2, 3))
        adam.zero_grad()
        loss.sum().backward()
        adam.step()
    assert float(loss.detach().max()) < 0.1 * float(answer.var())


def test_a_job_trains_it_and_what_is_saved_drives_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    quick = [
        "debug=quick",
        "policy.inputs=[leader_speed,follower_speed]",
        "data.frames=200",
        "learner.epochs=6",
        "tracking.enabled=false",
        "figures=none",
    ]
    result = cfx.run(["policy=tcn", "policy.channels=8", "policy.levels=2", *quick])
    assert isinstance(result.policy.core.network, TcnNetwork)
    curves = pd.read_parquet(result.folder / "curves.parquet").groupby("epoch").train_loss.mean()
    assert curves.iloc[-1] < curves.iloc[0]
    again = cfx.load(result.folder).policy.core.network
    tokens = noise(4, 1, 9, 10).float()
    mine, theirs = (
        network(tokens, network.initial_state(4, 1))[0]
        for network in (result.policy.core.network, again)
    )
    assert torch.equal(mine, theirs)
