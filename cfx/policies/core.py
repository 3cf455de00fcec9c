"""The tensor functions of a policy that training, evaluation and live drivers share.

Shapes: N networks, D drivers of each (or in any order), P pairs, a driver each, B drivers of the
network that has most, L frames of a token, f features of a token, c features of conditioning, n
tuned parameters, s width of the policy's state. `*batch` are any leading dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import Scaler, token_width, tokens
from cfx.policies.heads.base import ParameterHead
from cfx.policies.history import History
from cfx.policies.inputs import policy_inputs, signals_beyond_recordings

ANY_DRIVER = "all"
"""Name of the network that is for any driver."""

_EDGE = 1e-6
"""How near to 0 and 1, whose logits are infinite, answers count before their median is taken."""


class Ensemble(PolicyNetwork):
    """N ensembles of M networks. All networks of an ensemble read the same tokens.

    An ensemble answers, for each parameter, the median of its networks' answers. Not the mean: one
    answer far out pulls the mean to where no network is, and a model with regimes (Wiedemann 74)
    then drives worse than with each of them: with the mean 0.747 m/s on unseen drivers, its single
    networks 0.665 to 0.708. Of an even number the median is the mean of the middle two in the
    squashed space (logits). An ensemble is put together of trained networks, not trained itself:
    the first dimension of its parameters is N M.
    """

    def __init__(self, members: PolicyNetwork, size: int) -> None:
        """Takes N M networks, those of one ensemble behind one another, and M."""
        super().__init__()
        self.members = members  # under this name the weights are saved
        self.size = size

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        return self._together(self.members.initial_state(networks * self.size, drivers))

    def observe(self, tokens: Tensor, state: Tensor) -> Tensor:
        apart = self._apart(state)
        return self._together(self.members.observe(self._for_each(tokens), apart))

    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        apart = self._apart(state)
        answers, after = self.members(self._for_each(tokens), apart)
        logits = torch.logit(answers, eps=_EDGE).view(len(state), self.size, *answers.shape[1:])
        return _median(logits).sigmoid(), self._together(after)

    def act_once(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        answers, after = self.members.act_once(self._for_each(tokens), self._apart(state))
        logits = torch.logit(answers, eps=_EDGE).view(len(state), self.size, *answers.shape[1:])
        return _median(logits).sigmoid_(), self._together(after)

    def _for_each(self, tokens: Tensor) -> Tensor:
        """Returns tokens `(N, *batch)` for each network, `(N M, *batch)`; of one N no copy."""
        return tokens.unsqueeze(1).expand(-1, self.size, *tokens.shape[1:]).flatten(0, 1)

    def _apart(self, state: Tensor) -> Tensor:
        """Arranges states `(N, B, M s)` as those of each network, `(N M, B, s)`."""
        networks, drivers, width = state.shape
        apart = state.view(networks, drivers, self.size, width // self.size)
        return apart.transpose(1, 2).flatten(0, 1)

    def _together(self, states: Tensor) -> Tensor:
        """Arranges the networks' states `(N M, B, s)` as `(N, B, M s)`."""
        apart = states.view(len(states) // self.size, self.size, *states.shape[1:])
        return apart.transpose(1, 2).flatten(2)


def _median(values: Tensor) -> Tensor:
    """Returns the medians over the second dimension; NaN where a value is.

    As `quantile(0.5)`, but of operations that exported networks have.
    """
    size = values.shape[1]
    ordered = values.sort(dim=1).values
    median = torch.lerp(ordered[:, (size - 1) // 2], ordered[:, size // 2], 0.5)
    return torch.where(values.isnan().any(dim=1), torch.nan, median)


class AgentCore:
    """N networks with their scaler, their inputs and their head, as pure functions of tensors.

    `network` and `scaler` are shared, not copied. State is passed in and returned, never kept.

    Attributes:
        policy: the component that built the networks.
        network: the networks.
        scaler: normalises what the networks read: tokens, then the head's conditioning on the base,
            then driver features.
        head: makes parameters of answers.
        inputs, summary, driver_features: what the networks read, as the policy's settings say.
        further_signals: those that the inputs read beyond the ones of every recording.
    """

    def __init__(
        self, policy: Policy, network: PolicyNetwork, scaler: Scaler, head: ParameterHead
    ) -> None:
        self.policy = policy
        self.network = network
        self.scaler = scaler
        self.head = head
        self.inputs = policy_inputs(policy.inputs)
        self.further_signals = signals_beyond_recordings(self.inputs)
        self.summary = policy.summary
        self.driver_features = policy.driver_features

    @property
    def ensemble_size(self) -> int:
        """The number of networks of an ensemble."""
        return ensemble_size(self.network)

    def to(self, device: torch.device) -> AgentCore:
        """Returns the same core on a device; networks and scaler are moved, not copied."""
        return AgentCore(
            self.policy, self.network.to(device), self.scaler.to(device), self.head.to(device)
        )

    def only(self, numbers: Tensor) -> AgentCore:
        """Returns the core of some of the N networks, `(M,)` int64."""
        at = numbers.to(self.scaler.mean.device)
        scaler = Scaler(self.scaler.mean[at], self.scaler.scale[at])
        size = self.ensemble_size
        members = (at[:, None] * size + torch.arange(size, device=at.device)).flatten()
        weights = {name: value[members] for name, value in self.network.state_dict().items()}
        network = network_with_weights(self.policy, weights, size, scaler, self.head.answers)
        return AgentCore(self.policy, network.to(at.device), scaler, self.head)

    def condition(self, base: Tensor, driver_features: Tensor | None) -> Tensor:
        """Returns what networks read of drivers in every window.

        Args:
            base: `(*batch, n)` in unit space; heads without a base ignore it.
            driver_features: `(*batch, k)`, all known; None where the policy has none.

        Returns:
            `(*batch, c)` in the dtype of the base, not normalised.
        """
        conditioning = self.head.condition(base)
        if driver_features is None or driver_features.shape[-1] == 0:
            return conditioning
        return torch.cat([conditioning, driver_features.to(base.dtype)], -1)

    def encode(self, history: History) -> Tensor:
        """Returns tokens `(*batch, f)` of recent frames `(*batch, L)`."""
        return tokens(history, self.inputs, self.summary)

    def answer(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Asks the networks about one window.

        Args:
            features: token and conditioning, `(N, D, f + c)`, not normalised.
            state: `(N, D, s)`.

        Returns:
            Answers `(N, D, n)` in [0, 1] and the networks' state afterwards.
        """
        answer, after = self.network(self.scaler(features[:, :, None]), state)
        return answer[:, :, 0], after

    def act_once(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """As `answer`, to the bits, for drivers who act now, of whom no gradient is asked."""
        scaled = (features - self.scaler.mean[:, None]).div_(self.scaler.scale[:, None])
        return self.network.act_once(scaled, state)

    def observe(self, features: Tensor, state: Tensor, present: Tensor) -> Tensor:
        """Lets the networks see one window without acting.

        Args:
            features: token and conditioning, `(N, D, f + c)`, not normalised.
            state: `(N, D, s)`.
            present: which drivers have this window; the others keep their state, bool `(N, D)`.

        Returns:
            The networks' state afterwards.
        """
        after = self.network.observe(self.scaler(features[:, :, None]), state)
        return torch.where(present[..., None], after, state)


def ensemble_size(network: PolicyNetwork) -> int:
    """Returns how many networks answer together; 1 where each answers alone."""
    if isinstance(network, Ensemble):
        return network.size
    return 1


def features_read(policy: Policy, head: ParameterHead, length: int) -> int:
    """Returns how many features a policy's networks read where a token holds `length` frames."""
    token = token_width(policy.inputs, policy.summary, length)
    return token + head.width + len(policy.driver_features)


def network_with_weights(
    policy: Policy, weights: Mapping[str, Tensor], size: int, scaler: Scaler, parameters: int
) -> PolicyNetwork:
    """Builds a policy's networks and gives them saved weights.

    Args:
        policy: the component that builds them.
        weights: their state dict.
        size: networks of an ensemble.
        scaler: of N networks; says how many there are and what they read.
        parameters: n.

    Returns:
        N networks in evaluation mode, in the precision of the scaler.
    """
    networks, features = scaler.mean.shape
    blank = torch.zeros((networks * size, parameters), dtype=scaler.mean.dtype)
    network = policy.build(features, blank[0], blank, torch.Generator().manual_seed(0))
    network = network.to(blank.dtype)
    if size > 1:
        network = Ensemble(network, size)
    network.load_state_dict(dict(weights))
    return network.eval()


def driver_places(network: Tensor) -> Tensor:
    """Numbers the drivers of each network from 0.

    Args:
        network: which network each driver has, `(D,)`.

    Returns:
        `(D,)` int64.
    """
    if len(network) == 0:
        return torch.zeros_like(network)
    order = torch.argsort(network, stable=True)
    counts = torch.bincount(network)
    first = counts.cumsum(0) - counts
    place = torch.empty_like(order)
    place[order] = torch.arange(len(network), device=network.device) - first[network[order]]
    return place


def group_by(names: Sequence[str]) -> tuple[Tensor, tuple[str, ...]]:
    """Groups D drivers by name.

    Returns:
        The number of each driver's group `(D,)`, and the groups' names in order of appearance.
    """
    groups = tuple(dict.fromkeys(names))
    return torch.tensor([groups.index(name) for name in names]), groups


class Grid:
    """Places P pairs as N networks by B drivers."""

    def __init__(self, network: Tensor, networks: int) -> None:
        """Takes which network learns from each pair, `(P,)`."""
        self.network = network
        self.place = driver_places(network)
        self.shape = (networks, int(self.place.max()) + 1)

    def scatter(self, values: Tensor) -> Tensor:
        """Arranges `(P, ...)` as `(N, B, ...)`, zero where a network has fewer drivers."""
        grid = values.new_zeros((*self.shape, *values.shape[1:]))
        grid[self.network, self.place] = values
        return grid

    def mean(self, values: Tensor) -> Tensor:
        """Returns the mean of `(P, n)` over each network's pairs, `(N, n)`."""
        networks = self.shape[0]
        total = values.new_zeros((networks, values.shape[1]))
        total = total.index_add_(0, self.network, values)
        return total / torch.bincount(self.network, minlength=networks)[:, None]
