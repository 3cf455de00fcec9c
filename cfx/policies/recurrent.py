"""Recurrent policies: N independent networks as one, by batched matrix products.

The equations, gate order and initialisation are those of `torch.nn.GRU` and `torch.nn.LSTM` (which
cannot be batched over their weights: `torch.func.vmap` has no rule for them); a test holds them
equal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from cfx.core.memory import require_memory
from cfx.policies.base import PolicyNetwork, PolicySettings

_BYTES = 16.0
"""Of a weight in training: itself, its gradient and what Adam remembers of it."""

_EDGE = 0.02
"""Least distance to a bound of an untrained network's answer, in unit space."""


def _side_by_side(windows: Sequence[Tensor]) -> Tensor:
    """Returns `(N, B, W, hidden)` of W windows; a single one, as drivers see it, is not copied."""
    if len(windows) == 1:
        return windows[0].unsqueeze(2)
    return torch.stack(list(windows), dim=2)


class RecurrentSettings(PolicySettings):
    """Settings of the recurrent policies."""

    hidden_size: int = Field(32, ge=1, le=4096, description="units of each recurrent layer")
    layers: int = Field(1, ge=1, le=16, description="recurrent layers")
    dropout: float = Field(
        0.0, ge=0, lt=1, description="dropout before the output layer while training"
    )
    start: Literal["fixed", "middle"] = Field(
        "fixed",
        description="what an untrained network answers: calibrated parameters, or about the middle"
        " of the bounds (paper)",
    )
    acting_bias: bool = Field(
        False,
        description="whether networks know if they act, or only observe what was measured: what"
        " they see while they act is their own doing",
    )


def _uniform(shape: tuple[int, ...], width: int, generator: torch.Generator) -> nn.Parameter:
    limit = 1 / math.sqrt(width)
    return nn.Parameter((2 * torch.rand(shape, generator=generator) - 1) * limit)


class RecurrentLayer(nn.Module):
    """One recurrent layer of N networks with `gates` gates."""

    def __init__(
        self, networks: int, inputs: int, hidden: int, gates: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.w_input = _uniform((networks, inputs, gates * hidden), hidden, generator)
        self.w_hidden = _uniform((networks, hidden, gates * hidden), hidden, generator)
        self.b_input = _uniform((networks, 1, gates * hidden), hidden, generator)
        self.b_hidden = _uniform((networks, 1, gates * hidden), hidden, generator)

    def project(self, x: Tensor) -> Tensor:
        """Input part of all gates at all windows: `(N, B, W, i)` to `(N, B, W, gates * hidden)`."""
        projected = torch.baddbmm(self.b_input, x.flatten(1, 2), self.w_input)
        return projected.view(*x.shape[:3], -1)

    def recur(self, h: Tensor) -> Tensor:
        """Hidden part of all gates: `(N, B, hidden)` to `(N, B, gates * hidden)`."""
        return torch.baddbmm(self.b_hidden, h, self.w_hidden)


class RecurrentNetwork(PolicyNetwork):
    """Stacked recurrent layers and a sigmoid output layer, N times.

    A subclass says what one cell does.
    """

    gates: int
    states: int
    """Tensors of width `hidden` that one layer carries from window to window."""

    def __init__(
        self, features: int, fixed: Tensor, settings: RecurrentSettings, generator: torch.Generator
    ) -> None:
        """Takes what the untrained networks answer in unit space, `(N, n)`."""
        super().__init__()
        networks, parameters = fixed.shape
        self.hidden = settings.hidden_size
        count = self.gates * self.hidden * (features + self.hidden) * settings.layers * networks
        require_memory(_BYTES * count, f"policy.hidden_size={self.hidden}")
        widths = [features, *[settings.hidden_size] * (settings.layers - 1)]
        self.layers = nn.ModuleList()
        for width in widths:
            layer = RecurrentLayer(networks, width, self.hidden, self.gates, generator)
            self.layers.append(layer)
        self.dropout = nn.Dropout(settings.dropout)
        weights = _uniform((networks, self.hidden, parameters), self.hidden, generator)
        if settings.start == "fixed":
            # Away from the bounds, where a sigmoid learns nothing.
            self.w_out = nn.Parameter(torch.zeros_like(weights))
            self.b_out = nn.Parameter(torch.logit(fixed[:, None, :].to(weights.dtype), eps=_EDGE))
        else:
            self.w_out = weights
            self.b_out = nn.Parameter(torch.zeros((networks, 1, parameters)))
        self.b_acting: nn.Parameter | None = None
        if settings.acting_bias:
            self.b_acting = nn.Parameter(torch.zeros((networks, 1, 1, self.gates * self.hidden)))

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        return self.w_out.new_zeros(
            (networks, drivers, self.hidden * self.states * len(self.layers))
        )

    def observe(self, tokens: Tensor, state: Tensor) -> Tensor:
        return self._recurred(tokens, state, acts=False)[1]

    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        x, after = self._recurred(tokens, state, acts=True)
        logits = torch.baddbmm(self.b_out, self.dropout(x).flatten(1, 2), self.w_out)
        return logits.view(*x.shape[:3], -1).sigmoid(), after

    def act_once(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        x, carried = tokens, []
        states = state.chunk(len(self.layers), dim=-1)
        for number, (layer, before) in enumerate(zip(self.layers, states, strict=True)):
            assert isinstance(layer, RecurrentLayer)
            projected = torch.baddbmm(layer.b_input, x, layer.w_input)
            if number == 0 and self.b_acting is not None:
                projected.add_(self.b_acting[:, 0])
            recurrent = layer.recur(before[..., : self.hidden])
            carried.append(self.cell_in_place(projected, recurrent, before))
            x = carried[-1][..., : self.hidden]
        logits = torch.baddbmm(self.b_out, self.dropout(x), self.w_out)
        after = carried[0] if len(carried) == 1 else torch.cat(carried, dim=-1)
        return logits.sigmoid_(), after

    def _recurred(self, tokens: Tensor, state: Tensor, *, acts: bool) -> tuple[Tensor, Tensor]:
        """Returns the outputs of the last layer, `(N, B, W, hidden)`, and the state afterwards."""
        x = tokens
        last = []
        states = state.chunk(len(self.layers), dim=-1)
        for number, (layer, before) in enumerate(zip(self.layers, states, strict=True)):
            assert isinstance(layer, RecurrentLayer)
            carried = before
            projected = layer.project(x)
            if number == 0 and acts and self.b_acting is not None:
                projected = projected + self.b_acting
            outputs = []
            for k in range(tokens.shape[2]):
                recurrent = layer.recur(carried[..., : self.hidden])
                carried = self.cell(projected[:, :, k], recurrent, carried)
                outputs.append(carried[..., : self.hidden])
            x = _side_by_side(outputs)
            last.append(carried)
        after = last[0] if len(last) == 1 else torch.cat(last, dim=-1)
        return x, after

    @staticmethod
    def cell(projected: Tensor, recurrent: Tensor, carried: Tensor) -> Tensor:
        """Returns what a layer carries after a window, `(*batch, states * width)`, output first.

        Elementwise over units: each reads its own column of every gate.

        Args:
            projected: input part of the gates, one behind the other, `(*batch, gates * width)`.
            recurrent: their hidden part, of the same shape.
            carried: before the window, `(*batch, states * width)`.
        """
        raise NotImplementedError

    @classmethod
    def cell_in_place(cls, projected: Tensor, recurrent: Tensor, carried: Tensor) -> Tensor:
        """As `cell`, to the bits, but may write into the gates: for networks that act at once."""
        return cls.cell(projected, recurrent, carried)
