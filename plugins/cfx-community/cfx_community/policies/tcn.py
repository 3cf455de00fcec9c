"""A temporal convolutional network (TCN) as a policy.

S. Bai, J. Z. Kolter and V. Koltun (2018), *An empirical evaluation of generic convolutional and
recurrent networks for sequence modeling*, arXiv:1803.01271: residual blocks of two causal
convolutions, whose dilation doubles from block to block.

Shapes: N networks, B drivers of each, W windows, f features of a token, n parameters; c channels, k
kernel width.
"""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from cfx.plugin import Policy, PolicyNetwork, PolicySettings, Settings

_EDGE = 0.02
"""How close to a bound an untrained network may start, in unit space: at the bound itself a sigmoid
learns nothing."""


class TcnSettings(PolicySettings):
    """Settings of `TcnPolicy`."""

    channels: int = Field(32, ge=1, description="channels of each convolution")
    levels: int = Field(
        3, ge=1, description="residual blocks; the dilation is 1, 2, 4, ... windows"
    )
    kernel: int = Field(
        3,
        ge=2,
        description="taps of each convolution; the network sees 1 + 2 (kernel - 1) (2^levels - 1)"
        " windows back, its own too",
    )
    dropout: float = Field(
        0.0, ge=0, lt=1, description="dropout after each convolution while training"
    )
    start: Literal["fixed", "middle"] = Field(
        "fixed",
        description="what an untrained network answers: calibrated parameters, or about the middle"
        " of the bounds",
    )

    @property
    def receptive_field(self) -> int:
        """How many windows, the present one included, an answer depends on."""
        return 1 + 2 * (self.kernel - 1) * int(2**self.levels - 1)


def _uniform(shape: tuple[int, ...], fan_in: int, generator: torch.Generator) -> nn.Parameter:
    """Returns weights as `torch.nn.Conv1d` draws them."""
    limit = 1 / math.sqrt(fan_in)
    return nn.Parameter((2 * torch.rand(shape, generator=generator) - 1) * limit)


class CausalConvolution(nn.Module):
    """One dilated causal convolution of N networks, as one batched matrix product over its taps."""

    def __init__(
        self,
        networks: int,
        inputs: int,
        outputs: int,
        kernel: int,
        dilation: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.inputs = inputs
        self.kernel = kernel
        self.dilation = dilation
        self.weight = _uniform((networks, kernel * inputs, outputs), kernel * inputs, generator)
        self.bias = _uniform((networks, 1, outputs), kernel * inputs, generator)

    @property
    def memory(self) -> int:
        """How many earlier windows it reads."""
        return (self.kernel - 1) * self.dilation

    def forward(self, x: Tensor, past: Tensor) -> tuple[Tensor, Tensor]:
        """Takes windows `(N, B, W, inputs)` and those before them `(N, B, memory, inputs)`.

        Returns:
            `(N, B, W, outputs)`, and the `past` of the windows that follow.
        """
        windows = x.shape[2]
        whole = torch.cat([past, x], dim=2)
        taps = []
        for tap in range(self.kernel):
            first = tap * self.dilation
            taps.append(whole[:, :, first : first + windows])
        read = torch.cat(taps, dim=-1)
        out = torch.baddbmm(self.bias, read.flatten(1, 2), self.weight)
        return out.view(*x.shape[:3], -1), whole[:, :, whole.shape[2] - self.memory :]


class ResidualBlock(nn.Module):
    """Two convolutions with dropout and a way around them."""

    def __init__(
        self,
        networks: int,
        inputs: int,
        channels: int,
        kernel: int,
        dilation: int,
        dropout: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.first = CausalConvolution(networks, inputs, channels, kernel, dilation, generator)
        self.second = CausalConvolution(networks, channels, channels, kernel, dilation, generator)
        self.around = None
        if inputs != channels:
            self.around = CausalConvolution(networks, inputs, channels, 1, 1, generator)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, past: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Takes windows `(N, B, W, inputs)` and what the two convolutions read before them.

        Returns:
            Windows `(N, B, W, channels)`, and what they have read for the windows that follow.
        """
        y, first = self.first(x, past[0])
        y, second = self.second(self.dropout(y.relu()), past[1])
        beside = x
        if self.around is not None:
            beside, _ = self.around(x, x[:, :, :0])
        return (self.dropout(y.relu()) + beside).relu(), [first, second]


class TcnNetwork(PolicyNetwork):
    """N temporal convolutional networks.

    The state holds the last inputs of every convolution, so that one window at a time costs one
    window. Before the first window they are 0: the zero padding of the paper.
    """

    def __init__(
        self, features: int, fixed: Tensor, settings: TcnSettings, generator: torch.Generator
    ) -> None:
        """Takes what the untrained networks answer in unit space, `(N, n)`."""
        super().__init__()
        networks, parameters = fixed.shape
        s, channels = settings, settings.channels
        widths = [features, *[channels] * (s.levels - 1)]
        self.blocks = nn.ModuleList(
            ResidualBlock(networks, width, channels, s.kernel, 2**level, s.dropout, generator)
            for level, width in enumerate(widths)
        )
        weights = _uniform((networks, channels, parameters), channels, generator)
        if s.start == "fixed":
            self.w_out = nn.Parameter(torch.zeros_like(weights))
            self.b_out = nn.Parameter(torch.logit(fixed[:, None, :].to(weights.dtype), eps=_EDGE))
        else:
            self.w_out = weights
            self.b_out = nn.Parameter(torch.zeros((networks, 1, parameters)))

    @property
    def _convolutions(self) -> list[CausalConvolution]:
        convolutions = []
        for block in self.blocks:
            assert isinstance(block, ResidualBlock)
            convolutions += [block.first, block.second]
        return convolutions

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        width = sum(self._widths())
        return self.w_out.new_zeros((networks, drivers, width))

    def _widths(self) -> list[int]:
        """Returns how much of the state each convolution takes."""
        return [convolution.memory * convolution.inputs for convolution in self._convolutions]

    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        pieces = torch.split(state, self._widths(), dim=-1)
        past = []
        for convolution, piece in zip(self._convolutions, pieces, strict=True):
            past.append(piece.view(*state.shape[:2], convolution.memory, convolution.inputs))
        x = tokens
        after = []
        for level, block in enumerate(self.blocks):
            x, read = block(x, past[2 * level : 2 * level + 2])
            for inputs in read:
                after.append(inputs.flatten(2))
        logits = torch.baddbmm(self.b_out, x.flatten(1, 2), self.w_out)
        return logits.view(*x.shape[:3], -1).sigmoid(), torch.cat(after, dim=-1)


class TcnPolicy(Policy):
    """Answers from a fixed number of past windows; a recurrent network learns what to remember.

    Differences from the paper: no weight normalisation (it speeds up long trainings; these take
    seconds); weights are drawn as PyTorch draws those of a convolution; a sigmoid keeps the answers
    within the parameters' bounds; training starts from calibrated parameters (`start=middle` does
    not).
    """

    schema: ClassVar[type[Settings]] = TcnSettings
    settings: TcnSettings

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return TcnNetwork(features, fixed, self.settings, generator)
