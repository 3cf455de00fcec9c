"""`simulator=sumo`: the same rollouts, with SUMO taking the steps."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from cfx.component import content_key, folder_hash
from cfx.errors import ConfigError, SumoError
from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.vtype import InSumo, VType
from cfx.simulation.base import Stepper
from cfx.simulators.sumo.channel import Array, Message
from cfx.simulators.sumo.installed import require_sumo
from cfx.simulators.sumo.schema import check_vtype
from cfx.simulators.sumo.session import Session

_REPLAYED = {"sigma": "0", "maxSpeed": "130"}
"""Attributes of every leader; how it drives is told it at each step."""

_STILL = {"speedFactor": "1", "sigma": "0"}
"""Attributes of a follower, unless its model gives them: SUMO's defaults would draw both at random."""

_Values = dict[str, Tensor | str]


class SumoStepper(Stepper):
    """Drives followers in SUMO, each on a road of its own behind its own leader.

    A follower enters with its exact position, speed and acceleration, and its leader has exactly the given ones at each step. One
    `advance` is one entry. What a model of SUMO's remembers beyond these three is kept from one `advance` to the next for
    followers whose parameters stay the same (they drive their whole way again, from where their parameters last changed); where a
    policy changes them, such a model begins anew. The models that cfx has equations of remember nothing else. Entering anew every
    0.5 s changed speeds within 30 s by less than 1e-11 m/s for Krauss, KraussOrig1, IDM, W99 and ACC, by up to 0.08 m/s for EIDM,
    0.04 for IDMM and 0.9 for CACC.

    A follower that runs into its leader stays, with a negative gap; one that enters ahead of its leader drives on freely, as SUMO
    sees nobody ahead of it.

    Differences to `cfx.simulation.rollout.MemoryStepper`: no gradients; always in double precision.

    Args:
        model: one that SUMO has.
        dt: time step, s, in whole milliseconds.
        workers: SUMO processes at most; None: one for each core.
        followers: in one network, each on its own road.
        seed: SUMO's own, for models that draw random numbers.

    Raises:
        ConfigError: SUMO does not have the model, or not as it is set up, or cannot count the time step.
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
                f"simulator=sumo: SUMO counts in milliseconds, so it cannot take the recording's steps of {dt:g} s"
            )
        self._session = Session(workers or _cores())

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
        if torch.is_grad_enabled() and any(
            tensor.requires_grad for tensor in (*follower, *leader, *p.values())
        ):
            raise SumoError(
                "SUMO gives no gradients: learn with learner=imitation, or drive with simulator=memory"
            )
        steps, batch = len(leader.position), follower.speed.shape
        if steps * follower.speed.numel() == 0:
            nothing = follower.speed.new_empty((steps, *batch))
            return follower, nothing, nothing
        kind = self._model.sumo_vtype(p)
        drive = _Drive.of(follower, leader, kind)
        if kind.remembers and isinstance(follower, _Driven):
            drive = follower.drive.then(drive)
        position, speed = (
            found.to(follower.speed).view(steps, *batch) for found in self._last(drive, kind, steps)
        )
        before = speed[-2] if steps > 1 else follower.speed
        end = _Driven(position[-1], speed[-1], (speed[-1] - before) / self.dt, follower.memory)
        end.drive = drive
        return end if kind.remembers else Follower(*end), position, speed

    def _last(self, drive: _Drive, kind: VType, steps: int) -> tuple[Tensor, Tensor]:
        """Drives everybody from his entry on; returns positions and speeds `(steps, n)` of the last steps."""
        count, frames = len(drive.entry), len(drive.leader_position)
        networks = math.ceil(count / self._followers)
        cuts = list(itertools.pairwise(round(count * k / networks) for k in range(networks + 1)))
        answers = self._session.drive(self._request(drive, kind, slice(a, b)) for a, b in cuts)
        rows = frames - drive.entry + torch.arange(-steps, 0)[:, None]

        def joined(name: str) -> Tensor:
            parts = (torch.from_numpy(answer.arrays[name]) for answer in answers)
            return torch.cat(
                [part.gather(0, rows[:, a:b]) for part, (a, b) in zip(parts, cuts, strict=True)],
                dim=1,
            )

        return joined("position"), joined("speed")

    def _request(self, drive: _Drive, kind: VType, own: slice) -> Message:
        """Returns the request for some followers, each from his entry on; for who enters late the last frame is repeated."""
        frames, entry = len(drive.leader_position), drive.entry[own]
        rows = (entry + torch.arange(frames - int(entry.min()))[:, None]).clamp(max=frames - 1)
        constants, names, attributes = _columns(drive.attributes, own)
        leader_constants, leader_names, leader_attributes = _columns(drive.leader_attributes, own)
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
            "start": drive.start[:, own].numpy(),
            "leader_position": drive.leader_position[:, own].gather(0, rows).numpy(),
            "leader_speed": drive.leader_speed[:, own].gather(0, rows).numpy(),
            "leader_acceleration": drive.leader_acceleration[:, own].gather(0, rows).numpy(),
        }
        return Message(header, arrays)


class _Driven(Follower):
    """A follower that knows its drive so far, for models that remember more than its state."""

    drive: _Drive


@dataclass(frozen=True)
class _Drive:
    """n drives from the frame on from which each follower's parameters hold; on the CPU, in double precision.

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
    def of(cls, follower: Follower, leader: Leader, kind: VType) -> _Drive:
        batch, steps = follower.speed.shape, len(leader.position)

        def frames(signal: Tensor) -> Tensor:
            missing = (1,) * (len(batch) - signal.dim() + 1)
            whole = (
                signal.detach().reshape(steps, *missing, *signal.shape[1:]).expand(steps, *batch)
            )
            return whole.reshape(steps, -1).to("cpu", torch.float64)

        def flat(values: Mapping[str, Tensor | str]) -> _Values:
            return {
                name: value if isinstance(value, str) else _flat(value, batch)
                for name, value in values.items()
            }

        return cls(
            leader_position=frames(leader.position),
            leader_speed=frames(leader.speed),
            leader_acceleration=frames(leader.acceleration),
            entry=torch.zeros(batch.numel(), dtype=torch.int64),
            start=torch.stack([_flat(state, batch) for state in follower[:3]]),
            attributes=flat(kind.attributes),
            leader_attributes=flat({"length": leader.length, **kind.leader}),
        )

    def then(self, following: _Drive) -> _Drive:
        """Returns this drive continued, where parameters stay the same, and the following one alone where they change."""
        if (
            len(self.entry) != len(following.entry)
            or self.attributes.keys() != following.attributes.keys()
        ):
            return following
        same = torch.ones_like(self.entry, dtype=torch.bool)
        for name, value in following.attributes.items():
            if isinstance(value, Tensor):
                same &= value == self.attributes[name]
        if not bool(same.any()):
            return following
        return _Drive(
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
        ConfigError: SUMO does not have it, or not as it is set up, or knows no such attribute.
        SumoError: SUMO is not installed, or another version.
    """
    require_sumo()
    if not isinstance(model, InSumo):
        raise ConfigError(
            f"simulator=sumo: SUMO has no car-following model {type(model).__name__}; choose model=krauss_sumo, idm_sumo, w99,"
            " krauss or sumo_vtype, or simulator=memory"
        )
    check_vtype(model.sumo_vtype(model.space.unpack(model.space.defaults())))
    return model


def _columns(
    values: Mapping[str, Tensor | str], own: slice
) -> tuple[dict[str, str], list[str], Array]:
    """Splits attributes into those that are one text for all, and the names and columns `(n, names)` of the others."""
    constants = {name: value for name, value in values.items() if isinstance(value, str)}
    columns = {name: value[own] for name, value in values.items() if isinstance(value, Tensor)}
    table = (
        torch.stack(list(columns.values()), dim=1)
        if columns
        else torch.empty((own.stop - own.start, 0), dtype=torch.float64)
    )
    return constants, list(columns), table.numpy()


def _flat(value: Tensor, batch: torch.Size) -> Tensor:
    return value.detach().expand(batch).reshape(-1).to("cpu", torch.float64)


def _cores() -> int:
    """Returns how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
