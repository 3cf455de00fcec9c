"""The steps of `simulator=sumo`: the same rollouts, with SUMO taking the steps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cfx.errors import ConfigError, SumoError, listed
from cfx.plugin import (
    DrivingModel,
    Follower,
    InSumo,
    Leader,
    Stepper,
    VType,
    content_key,
    folder_hash,
    threads,
)
from cfx_sumo.installed import require_sumo
from cfx_sumo.limits import lost_limits
from cfx_sumo.simulation.schema import check_vtype
from cfx_sumo.simulation.session import Session
from cfx_sumo.simulation.worker import Array, Request

_REPLAYED = {"sigma": "0", "maxSpeed": "130"}
"""Attributes of every leader; its movement is prescribed at each step."""

_STILL = {"speedFactor": "1", "sigma": "0"}
"""Attributes of a follower, unless its model gives them; SUMO's defaults make both random."""

_SHORTEST_M = 0.1
"""Length of a vehicle in SUMO whose own is not known."""

_Values = dict[str, Tensor | str]


class SumoStepper(Stepper):
    """Advances followers in SUMO, each on a road of its own behind its own leader.

    A follower enters with its exact position, speed and acceleration, and its leader has exactly
    the given ones at each step. One `advance` is one entry. What a model of SUMO's remembers beyond
    these three is kept from one `advance` to the next for followers whose parameters stay the same
    (they are simulated again from where their parameters last changed). Where a policy changes
    them, such a model begins anew. The models that cfx has equations of remember nothing
    else. Entering anew every 0.5 s changed speeds within 30 s by less than 1e-11 m/s for Krauss,
    KraussOrig1, IDM, W99 and ACC, by up to 0.08 m/s for EIDM, 0.04 for IDMM and 0.9 for CACC.

    A follower that runs into its leader stays, with a negative gap; one that enters ahead of its
    leader drives on freely, as SUMO sees nobody ahead of it.

    Differences to `cfx.simulation.rollout.MemoryStepper`: no gradients; always in double precision.

    Args:
        model: one that SUMO has.
        dt: time step, s, in whole milliseconds.
        workers: SUMO processes; None: one for each core.
        followers: in one network, each on its own road.
        seed: SUMO's own, for models that draw random numbers.

    Raises:
        ConfigError: SUMO does not have the model, or not as it is set up, or cannot count the time
            step.
        SumoError: SUMO is not installed, or another version.
    """

    def __init__(
        self,
        model: DrivingModel,
        dt: float,
        *,
        workers: int | None = None,
        followers: int = 50,
        seed: int = 23423,
    ) -> None:
        super().__init__(model, dt)
        self._model = require_in_sumo(model)
        self._followers = followers
        self._seed = seed
        if round(dt * 1000) < 1 or abs(dt - round(dt * 1000) / 1000) > 1e-9:
            raise ConfigError(
                "simulator=sumo: SUMO counts in milliseconds, so it cannot take the recording's"
                f" steps of {dt:g} s"
            )
        self._session = Session(workers or threads.cores())

    def identity(self) -> str:
        return content_key(
            {
                "sumo": require_sumo(),
                "code": folder_hash(__file__),
                "followers": self._followers,
                "seed": self._seed,
            }
        )

    def close(self) -> None:
        self._session.close()

    def advance(
        self, follower: Follower, leader: Leader, p: Mapping[str, Tensor]
    ) -> tuple[Follower, Tensor, Tensor]:
        inputs = (*follower, *leader, *p.values())
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs):
            raise SumoError(
                "SUMO gives no gradients: learn with learner=imitation, or drive with"
                " simulator=memory"
            )
        steps, batch = len(leader.position), follower.speed.shape
        if steps * follower.speed.numel() == 0:
            nothing = follower.speed.new_empty((steps, *batch))
            return follower, nothing, nothing
        kind = self._model.sumo_vtype(p)
        scene = _Scene.of(follower, leader, kind)
        if kind.remembers and isinstance(follower, _Remembering):
            scene = follower.scene.then(scene)
        positions, speeds = self._last(scene, kind, steps)
        position = positions.to(follower.speed).view(steps, *batch)
        speed = speeds.to(follower.speed).view(steps, *batch)
        before = speed[-2] if steps > 1 else follower.speed
        acceleration = (speed[-1] - before) / self.dt
        if not kind.remembers:
            end = Follower(position[-1], speed[-1], acceleration, follower.memory)
            return end, position, speed
        remembering = _Remembering(position[-1], speed[-1], acceleration, follower.memory)
        remembering.scene = scene
        return remembering, position, speed

    def _last(self, scene: _Scene, kind: VType, steps: int) -> tuple[Tensor, Tensor]:
        """Simulates every follower from its entry on.

        Returns:
            Positions and speeds `(steps, n)` of the last steps.
        """
        count, frames = len(scene.entry), len(scene.leader_position)
        networks = math.ceil(count / self._followers)
        cuts = [round(count * k / networks) for k in range(networks + 1)]
        parts = [slice(first, last) for first, last in itertools.pairwise(cuts)]
        answers = self._session.answer([self._request(scene, kind, part) for part in parts])
        rows = frames - scene.entry + torch.arange(-steps, 0)[:, None]
        positions, speeds = [], []
        for part, answer in zip(parts, answers, strict=True):
            rows_of_part = rows[:, part]
            positions.append(torch.from_numpy(answer.position).gather(0, rows_of_part))
            speeds.append(torch.from_numpy(answer.speed).gather(0, rows_of_part))
        return torch.cat(positions, dim=1), torch.cat(speeds, dim=1)

    def _request(self, scene: _Scene, kind: VType, part: slice) -> Request:
        """Returns the request for some followers, each from its entry on.

        For those that enter late the last frame is repeated.
        """
        frames, entry = len(scene.leader_position), scene.entry[part]
        rows = (entry + torch.arange(frames - int(entry.min()))[:, None]).clamp(max=frames - 1)
        constants, names, attributes = _columns(scene.attributes, part)
        leader_constants, leader_names, leader_attributes = _columns(scene.leader_attributes, part)
        header = {
            "dt": round(self.dt * 1000) / 1000,
            "seed": self._seed,
            "car_follow_model": kind.car_follow_model,
            "constants": _STILL | constants,
            "names": names,
            "leader_constants": _REPLAYED | leader_constants,
            "leader_names": leader_names,
        }
        arrays = {
            "attributes": attributes,
            "leader_attributes": leader_attributes,
            "start": scene.start[:, part].numpy(),
            "leader_position": scene.leader_position[:, part].gather(0, rows).numpy(),
            "leader_speed": scene.leader_speed[:, part].gather(0, rows).numpy(),
            "leader_acceleration": scene.leader_acceleration[:, part].gather(0, rows).numpy(),
        }
        return Request(header, arrays)


class _Remembering(Follower):
    """A follower of a model that remembers more than its state: it knows its scene so far."""

    scene: _Scene


@dataclass(frozen=True)
class _Scene:
    """What SUMO simulates: n followers, each from where its parameters begin to hold.

    The tensors lie on the CPU, in double precision.

    Attributes:
        leader_position, leader_speed, leader_acceleration: `(T, n)`, from the first `advance` on.
        entry: `(n,)` int64, the frame at which each follower enters SUMO.
        start: `(3, n)`, position, speed and acceleration there.
        attributes, leader_attributes: `(n,)` or a text each.
    """

    leader_position: Tensor
    leader_speed: Tensor
    leader_acceleration: Tensor
    entry: Tensor
    start: Tensor
    attributes: _Values
    leader_attributes: _Values

    @classmethod
    def of(cls, follower: Follower, leader: Leader, kind: VType) -> _Scene:
        batch = follower.speed.shape
        states = (follower.position, follower.speed, follower.acceleration)
        # A length of 0 says that a position is a rear bumper's; SUMO's vehicles have a length.
        length = leader.length.clamp(min=_SHORTEST_M)
        return cls(
            leader_position=_frames(leader.position + (length - leader.length), batch),
            leader_speed=_frames(leader.speed, batch),
            leader_acceleration=_frames(leader.acceleration, batch),
            entry=torch.zeros(batch.numel(), dtype=torch.int64),
            start=torch.stack([_flat(state, batch) for state in states]),
            attributes=_flat_values(kind.attributes, batch),
            leader_attributes=_flat_values({"length": length, **kind.leader}, batch),
        )

    def then(self, following: _Scene) -> _Scene:
        """Returns this scene continued for followers whose parameters stay the same.

        The others enter anew, as in the following scene alone.
        """
        if len(self.entry) != len(following.entry):
            return following
        if self.attributes.keys() != following.attributes.keys():
            return following
        same = torch.ones_like(self.entry, dtype=torch.bool)
        for name, value in following.attributes.items():
            if isinstance(value, Tensor):
                same &= value == self.attributes[name]
        if not bool(same.any()):
            return following
        return _Scene(
            torch.cat([self.leader_position, following.leader_position]),
            torch.cat([self.leader_speed, following.leader_speed]),
            torch.cat([self.leader_acceleration, following.leader_acceleration]),
            torch.where(same, self.entry, len(self.leader_position)),
            torch.where(same, self.start, following.start),
            following.attributes,
            following.leader_attributes,
        )


def require_in_sumo(model: DrivingModel) -> InSumo:
    """Returns the model as what SUMO drives.

    Raises:
        ConfigError: SUMO does not have it, or not as it is set up, or knows no such attribute or
            limit.
        SumoError: SUMO is not installed, or another version.
    """
    require_sumo()
    if not isinstance(model, InSumo):
        raise ConfigError(
            f"simulator=sumo: SUMO has no car-following model {type(model).__name__}; choose"
            " model=krauss_sumo, idm_sumo, w99, krauss or sumo_vtype, or simulator=memory"
        )
    kind = model.sumo_vtype(model.space.unpack(model.space.defaults()))
    check_vtype(kind)
    lost = lost_limits(model, kind)
    if lost:
        raise ConfigError(
            f"simulator=sumo: SUMO knows nothing of {listed(lost)}, and keeps to its vType's accel,"
            " decel and emergencyDecel; leave it out, or choose simulator=memory"
        )
    return model


def _columns(
    values: Mapping[str, Tensor | str], part: slice
) -> tuple[dict[str, str], list[str], Array]:
    """Splits attributes into constants, and the names and columns `(n, names)` of the others."""
    constants: dict[str, str] = {}
    columns: dict[str, Tensor] = {}
    for name, value in values.items():
        if isinstance(value, str):
            constants[name] = value
        else:
            columns[name] = value[part]
    if not columns:
        return constants, [], np.empty((part.stop - part.start, 0))
    return constants, list(columns), torch.stack(list(columns.values()), dim=1).numpy()


def _frames(signal: Tensor, batch: torch.Size) -> Tensor:
    """Returns a leader's signal as `(T, n)`."""
    steps = len(signal)
    missing = (1,) * (len(batch) - signal.dim() + 1)
    full = signal.detach().reshape(steps, *missing, *signal.shape[1:]).expand(steps, *batch)
    return full.reshape(steps, -1).to("cpu", torch.float64)


def _flat_values(values: Mapping[str, Tensor | str], batch: torch.Size) -> _Values:
    flat: _Values = {}
    for name, value in values.items():
        flat[name] = value if isinstance(value, str) else _flat(value, batch)
    return flat


def _flat(value: Tensor, batch: torch.Size) -> Tensor:
    return value.detach().expand(batch).reshape(-1).to("cpu", torch.float64)
