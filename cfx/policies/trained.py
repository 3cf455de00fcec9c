"""A policy that is ready to drive: networks, what they read, and the model whose parameters they choose.

Kept in a folder as `policy.pt` (a state dict, read with `weights_only=True`) and `policy.json` (everything else).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from cfx import registry, renamed
from cfx.calibration.windows import WindowSettings
from cfx.errors import DataError
from cfx.files import atomic_write
from cfx.models.base import DrivingModel
from cfx.pairs import PairBatch, PairSet
from cfx.parameters import ParameterSpace
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.driver_features import measure
from cfx.policies.ensemble import Ensemble
from cfx.policies.features import History, token_width, tokens
from cfx.policies.offsets import coordinates, drawn, moved

if TYPE_CHECKING:
    import pandas as pd

_FORMAT = 1

ALL = "all"
"""Name of the network that is for any driver."""


class Scaler(nn.Module):
    """Brings each network's tokens to mean 0 and standard deviation 1 over its training windows."""

    def __init__(self, mean: Tensor, scale: Tensor) -> None:
        """Takes `(N, f)` each."""
        super().__init__()
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("scale", scale)

    @classmethod
    def of(cls, values: Tensor, mask: Tensor) -> Scaler:
        """Measures tokens `(N, B, W, f)` where `mask` `(N, B, W)`; a feature that does not vary keeps scale 1."""
        weight = mask[..., None].to(values.dtype)
        total = weight.sum((1, 2)).clamp(min=1.0)
        mean = (values * weight).sum((1, 2)) / total
        variance = ((values - mean[:, None, None]).square() * weight).sum((1, 2)) / total
        scale = variance.sqrt()
        return cls(mean, torch.where(scale > 1e-6, scale, 1.0))

    def forward(self, values: Tensor) -> Tensor:
        return (values - self.mean[:, None, None]) / self.scale[:, None, None]


class PolicyState(NamedTuple):
    """Where D drivers stand: which network drives each, its place among that network's drivers, and the networks' state.

    Attributes:
        network: `(D,)` int64.
        place: `(D,)` int64.
        state: `(N, B, s)`.
        base: parameters that answers are offsets from, `(D, n)` in unit space; None where answers are the parameters themselves.
        driver features: the drivers' driver features, `(D, k)`, or what stands for those of unseen drivers; None where the policy is told none.
    """

    network: Tensor
    place: Tensor
    state: Tensor
    base: Tensor | None = None
    driver_features: Tensor | None = None


@dataclass(frozen=True)
class TrainedPolicy:
    """N networks that drive.

    Attributes:
        policy: the component that built the networks.
        network: the networks themselves.
        scaler: normalises what a network is shown: tokens, the base in the squashed space where answers are offsets, and driver features,
            one behind the other.
        model_node: config node of the driving model.
        space: the model's parameters; where answers are offsets, as far as they reach.
        windows: how often parameters change, and how many frames a token holds.
        dt: time step, s.
        names: what each network was trained for (a pair's id, a fold, or `ALL`), N of them.
        base: parameters that answers are offsets from (`cfx.policies.offsets`) for a driver who brings none of his own, `(N, n)`
            in SI units; None if answers are the parameters themselves.
        shrinkage: how far a driver's own parameters are drawn towards the model's default before offsets start from them, as they
            were in training.
        own: whether offsets start from a driver's own parameters where these are known, or from `base` for everybody.
        history: seconds of a driver's measured history that it read before its test; None: all there was.
        population: constant parameters calibrated on those whom each network learned from, `(N, n)` in SI units; None if there
            are none.
        learned_from: the pairs that something of it was learned from or calibrated on: `Pair.content` and the driver's name.
    """

    policy: Policy
    network: PolicyNetwork
    scaler: Scaler
    model_node: Mapping[str, Any]
    policy_node: Mapping[str, Any]
    space: ParameterSpace
    windows: WindowSettings
    dt: float
    names: tuple[str, ...]
    base: Tensor | None = None
    shrinkage: float = 0.0
    own: bool = True
    history: float | None = None
    population: Tensor | None = None
    learned_from: Mapping[str, str] = field(default_factory=dict)

    def base_of(self, own: Tensor) -> Tensor:
        """Returns what offsets start from for drivers whose own parameters are these; both `(D, n)` in SI units."""
        return drawn(self.space, own, self.shrinkage)

    def driver_features_of(
        self, batch: PairBatch, until: Tensor, since: Tensor | None = None
    ) -> Tensor | None:
        """Measures what the policy is told of D drivers before they drive.

        Args:
            batch: their D pairs.
            until: `(D,)`, the frame at which each will start to drive; those before it are measured.
            since: `(D,)`, the frame from which on; None: from the first.

        Returns:
            Driver features `(D, k)`, NaN for a driver of whom too little was measured; None if the policy is told none.
        """
        if not self.policy.driver_features:
            return None
        return measure(
            batch,
            self.policy.driver_features,
            self.dt,
            torch.zeros_like(until) if since is None else since,
            until,
        )

    def begin(
        self, network: Tensor, base: Tensor | None = None, driver_features: Tensor | None = None
    ) -> PolicyState:
        """Returns the state of D drivers before their first window.

        Args:
            network: `(D,)`, which network drives each.
            base: `(D, n)` in SI units, what each driver's offsets start from (`base_of`); None: the policy's, for drivers of whom
                nothing is known. Ignored where answers are not offsets.
            driver features: `(D, k)`, as `traits_of` measures them; NaN, or None: unknown. Then the mean of those stands for them whom the
                network learned from.
        """
        place = driver_places(network)
        drivers = int(place.max()) + 1
        unit = None
        if self.base is not None:
            unit = self.space.to_unit((self.base[network] if base is None else base).double())
        told = None
        if self.policy.driver_features:
            unknown = self.scaler.mean[network, -len(self.policy.driver_features) :].double()
            told = (
                unknown
                if driver_features is None
                else torch.where(driver_features.isnan(), unknown, driver_features.to(unknown))
            )
        return PolicyState(
            network, place, self.network.initial_state(len(self.names), drivers), unit, told
        )

    @torch.no_grad()
    def act(self, history: History, state: PolicyState) -> tuple[Tensor, PolicyState]:
        """Chooses the parameters of the next window.

        Args:
            history: the last `windows.length` frames of D drivers, `(D, length)` each.
            state: where they stand.

        Returns:
            Parameters `(D, n)` in SI units, in the dtype of the history, and where they stand now.
        """
        seen = tokens(history, self.policy.inputs, self.policy.summary)
        if state.base is not None:
            seen = torch.cat([seen, coordinates(state.base).to(seen.dtype)], -1)
        if state.driver_features is not None:
            seen = torch.cat([seen, state.driver_features.to(seen.dtype)], -1)
        networks, drivers, _ = state.state.shape
        grid = seen.new_zeros((networks, drivers, 1, seen.shape[-1]), dtype=self.scaler.mean.dtype)
        grid[state.network, state.place, 0] = seen.to(grid.dtype)
        unit, after = self.network(self.scaler(grid), state.state)
        chosen = unit[state.network, state.place, 0].to(seen.dtype)
        if state.base is not None:
            chosen = moved(state.base, chosen.double(), self.space.free(device=chosen.device)).to(
                seen.dtype
            )
        return self.space.from_unit(chosen), state._replace(state=after)

    def read(
        self, batch: PairBatch, until: Tensor, state: PolicyState, since: Tensor | None = None
    ) -> PolicyState:
        """Lets D drivers read their measured history before they drive.

        Args:
            batch: their D pairs.
            until: `(D,)`, the frame at which each will start to drive; windows that start before it are read.
            state: where they stand.
            since: `(D,)`, the frame from which on they read; None: from the first.
        """
        stride = self.windows.stride
        begin = 0 if since is None else int(since.min()) // stride * stride
        each = torch.arange(len(batch), device=until.device)
        for first in range(begin, int(until.max()), stride):
            _, after = self.act(
                measured_history(batch, each, torch.full_like(until, first), self.windows.length),
                state,
            )
            reading = ((first < until) & (first >= (0 if since is None else since)))[:, None]
            merged = state.state.clone()
            kept, new = (
                state.state[state.network, state.place],
                after.state[state.network, state.place],
            )
            merged[state.network, state.place] = torch.where(reading, new, kept)
            state = state._replace(state=merged)
        return state

    def predict_frame(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Chooses parameters for the end of each pair in a tidy table.

        Args:
            frame: measured history in the tidy pair layout, one or more pairs with the policy's time step.

        Returns:
            A row per pair: `pair_id` and one column per tuned parameter (SI units), for the window that starts at the
            pair's last frame. A pair that the policy was trained for is driven by its own network; any other by the only network
            there is, or the one named `all`.

        Raises:
            DataError: the table is not in the tidy layout, its time step is another, or it is not clear which network to use.
        """
        import pandas as pd

        from cfx.datasets.tidy import pairs_from_frame

        pairs = pairs_from_frame(frame, source="the table given to the policy")
        if abs(pairs.dt - self.dt) > 1e-6:
            raise DataError(
                f"the policy was trained at time steps of {self.dt:g} s, the table has {pairs.dt:g} s; resample the table"
            )
        batch = PairBatch.of(pairs)
        until = batch.lengths - 1
        state = self.read(
            batch,
            until,
            self.begin(
                self.networks_for(pairs), driver_features=self.driver_features_of(batch, until)
            ),
        )
        chosen, _ = self.act(
            measured_history(batch, torch.arange(len(batch)), until, self.windows.length), state
        )
        return pd.DataFrame(
            {
                "pair_id": [pair.pair_id for pair in pairs],
                **dict(zip(self.space.names, chosen.T.tolist(), strict=True)),
            }
        )

    def networks_for(self, pairs: PairSet) -> Tensor:
        """Returns which network drives each pair, `(P,)`.

        Raises:
            DataError: a pair is none of those the networks were trained for, and there are several networks.
        """
        if len(self.names) == 1:
            return torch.zeros(len(pairs), dtype=torch.int64)
        number = {name: index for index, name in enumerate(self.names)}
        unknown = [pair.pair_id for pair in pairs if pair.pair_id not in number]
        if unknown and ALL not in number:
            raise DataError(
                f"pair '{unknown[0]}' has no network of its own among the {len(self.names)} that were trained, one per pair;"
                " train with protocol.networks=all or protocol=across_drivers to drive others"
            )
        return torch.tensor([number.get(pair.pair_id, number.get(ALL, 0)) for pair in pairs])

    def for_unseen_drivers(self) -> TrainedPolicy:
        """Returns the one network that drives anybody: the only one there is, or the one named `all`.

        Raises:
            DataError: each network is for a pair of its own.
        """
        if len(self.names) == 1:
            return self
        if ALL not in self.names:
            raise DataError(
                f"the policy has {len(self.names)} networks, one for each of its own pairs, and none for others; train one with"
                " protocol.networks=all or protocol=across_drivers"
            )
        at = torch.tensor([self.names.index(ALL)], device=self.scaler.mean.device)
        size = self.network.size if isinstance(self.network, Ensemble) else 1
        members = (at[:, None] * size + torch.arange(size, device=at.device)).flatten()
        weights = {name: value[members] for name, value in self.network.state_dict().items()}
        return replace(
            self,
            network=_network(self.policy, weights, size, self.scaler.mean[at], self.space).to(
                at.device
            ),
            scaler=Scaler(self.scaler.mean[at], self.scaler.scale[at]),
            names=(ALL,),
            base=self.base[at] if self.base is not None else None,
            population=self.population[at] if self.population is not None else None,
        )

    def to(self, device: torch.device) -> TrainedPolicy:
        """Moves everything to a device."""
        return replace(
            self,
            network=self.network.to(device),
            scaler=self.scaler.to(device),
            base=self.base.to(device) if self.base is not None else None,
            population=self.population.to(device) if self.population is not None else None,
        )

    def save(self, folder: Path) -> None:
        """Writes `policy.pt` and `policy.json`; each appears whole."""
        weights = {
            f"network.{key}": value.cpu() for key, value in self.network.state_dict().items()
        }
        weights |= {f"scaler.{key}": value.cpu() for key, value in self.scaler.state_dict().items()}
        weights |= {
            name: value.cpu()
            for name, value in {"base": self.base, "population": self.population}.items()
            if value is not None
        }
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(folder / "policy.pt") as temporary:
            torch.save(weights, temporary)
        description = {
            "format": _FORMAT,
            "policy": dict(self.policy_node),
            "model": dict(self.model_node),
            "parameters": list(self.space.names),
            "windows": self.windows.model_dump(),
            "dt": self.dt,
            "names": list(self.names),
            "ensemble_size": self.network.size if isinstance(self.network, Ensemble) else 1,
            "shrinkage": self.shrinkage,
            "own": self.own,
            "history": self.history,
            "learned_from": dict(self.learned_from),
        }
        with atomic_write(folder / "policy.json") as temporary:
            temporary.write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, folder: Path | str) -> TrainedPolicy:
        """Reads what `save` wrote, on the CPU.

        Raises:
            DataError: the folder holds no policy, or one of another format.
            PluginError: the model or the policy is not installed.
        """
        folder = Path(folder)
        try:
            description = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
            weights = torch.load(folder / "policy.pt", weights_only=True, map_location="cpu")
        except (OSError, ValueError, RuntimeError) as error:
            raise DataError(
                f"{folder} holds no policy that can be read ({error}); give a job's folder"
            ) from error
        if description.get("format") != _FORMAT:
            raise DataError(
                f"{folder}/policy.json has format {description.get('format')}; this version of cfx reads format {_FORMAT}"
            )
        policy_node = renamed.node("policy", description["policy"])
        model_node = renamed.node("model", description["model"])
        policy = registry.create("policy", policy_node)
        model = registry.create("model", model_node)
        assert isinstance(policy, Policy)
        assert isinstance(model, DrivingModel)
        windows = WindowSettings(**description["windows"])
        mean = weights["scaler.mean"]
        features = mean.shape[1]
        base = weights.get("base")
        space = model.space if base is None else model.adaptation_space
        width = token_width(policy.inputs, policy.summary, windows.length) + (
            len(space) if base is not None else 0
        )
        width += len(policy.driver_features)
        if features != width:
            raise DataError(
                f"{folder}: the weights read {features} features, the policy's settings give {width}"
            )
        trained = {
            k.removeprefix("network."): v for k, v in weights.items() if k.startswith("network.")
        }
        return cls(
            policy=policy,
            network=_network(policy, trained, _ensemble_size(description), mean, space),
            scaler=Scaler(mean, weights["scaler.scale"]),
            model_node=model_node,
            policy_node=policy_node,
            space=space,
            windows=windows,
            dt=description["dt"],
            names=tuple(description["names"]),
            base=base,
            shrinkage=description.get("shrinkage", 0.0),
            own=description.get("own", True),
            history=description.get("history"),
            population=weights.get("population"),
            learned_from=description.get("learned_from", {}),
        )


def _ensemble_size(description: Mapping[str, Any]) -> int:
    """Returns how many networks answer together; the version before called them members."""
    return int(description.get("ensemble_size", description.get("members", 1)))


def _network(
    policy: Policy, weights: Mapping[str, Tensor], size: int, mean: Tensor, space: ParameterSpace
) -> PolicyNetwork:
    """Returns networks with these weights, ensembles of `size` each; `mean` `(N, f)` says how many, and what they read."""
    networks, features = mean.shape
    blank = torch.zeros((networks * size, len(space)), dtype=mean.dtype)
    network = policy.build(features, blank[0], blank, torch.Generator().manual_seed(0)).to(
        blank.dtype
    )
    network = Ensemble(network, size) if size > 1 else network
    network.load_state_dict(dict(weights))
    return network.eval()


def measured_history(batch: PairBatch, pair: Tensor, frame: Tensor, length: int) -> History:
    """Returns the last `length` measured frames up to a frame; the first frame stands for those before it.

    Args:
        batch: P pairs.
        pair: which of them, `(*shape)`.
        frame: `(*shape)`, or what broadcasts with it.
        length: frames.

    Returns:
        Signals of `(*shape, length)`.
    """
    index = (frame[..., None] + torch.arange(1 - length, 1, device=frame.device)).clamp(min=0)
    return History(*(signal[pair[..., None], index] for signal in History.of(batch)))


def driver_places(network: Tensor) -> Tensor:
    """Numbers the drivers of each network from 0, `(D,)`."""
    same = network[:, None] == network[None, :]
    return torch.tril(same, diagonal=-1).sum(1)


def group_by(names: Sequence[str]) -> tuple[Tensor, tuple[str, ...]]:
    """Returns for D drivers the number of their group `(D,)`, and the groups' names in order of appearance."""
    order = {name: index for index, name in enumerate(dict.fromkeys(names))}
    return torch.tensor([order[name] for name in names]), tuple(order)
