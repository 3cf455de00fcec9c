"""What calibration minimises: how far a simulated drive is from the recorded one."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from cfx.models.base import Leader
from cfx.pairs import PairBatch
from cfx.simulation.base import BaseSimulator
from cfx.simulation.rollout import Start


@dataclass(frozen=True)
class DriveObjective:
    """RMSE of speed of P closed-loop drives, for q candidate parameter sets each.

    Each problem starts from a measured state and follows its measured leader for up to K steps.

    Attributes:
        simulator: the model and its time step.
        leader_position, leader_speed, leader_acceleration: frames 0 to K - 1, `(K, P)`.
        leader_length: `(P,)`, m.
        start_position, start_speed, start_acceleration: measured follower at frame 0, `(P,)`.
        observed: measured follower speed at frames 1 to K, `(K, P)`, m/s.
        counted: frames that count, `(K, P)`, 1 or 0.
    """

    simulator: BaseSimulator
    leader_position: Tensor
    leader_speed: Tensor
    leader_acceleration: Tensor
    leader_length: Tensor
    start_position: Tensor
    start_speed: Tensor
    start_acceleration: Tensor
    observed: Tensor
    counted: Tensor

    @classmethod
    def of_segments(
        cls, simulator: BaseSimulator, batch: PairBatch, pair: Tensor, first: Tensor, steps: Tensor
    ) -> DriveObjective:
        """Cuts segments out of pairs.

        Args:
            pair: `(P,)`, index of each segment's pair in the batch.
            first: `(P,)`, frame at which the segment starts (the measured state).
            steps: `(P,)`, steps to simulate; frames `first + 1` to `first + steps` are compared.
        """
        k = torch.arange(int(steps.max()), device=pair.device)[:, None]
        now = (first + k).clamp(max=batch.mask.shape[1] - 1)
        after = (now + 1).clamp(max=batch.mask.shape[1] - 1)
        return cls(
            simulator,
            batch.leader_position[pair, now],
            batch.leader_speed[pair, now],
            batch.leader_acceleration[pair, now],
            batch.leader_length[pair],
            batch.follower_position[pair, first],
            batch.follower_speed[pair, first],
            batch.follower_acceleration[pair, first],
            batch.follower_speed[pair, after],
            (k < steps).to(batch.follower_speed.dtype),
        )

    @property
    def problems(self) -> int:
        """P."""
        return len(self.leader_length)

    @property
    def bytes_per_candidate(self) -> int:
        """Memory that one candidate of one problem needs: positions, speeds and the intermediate values of one block."""
        return (4 * len(self.observed) + 32) * self.observed.element_size()

    def select(self, first: int, last: int) -> DriveObjective:
        """Returns problems `first` to `last - 1`."""
        return self._cut(slice(first, last))

    def take(self, problems: Tensor) -> DriveObjective:
        """Returns the problems of these numbers, `(S,)` int64; one may stand there more than once."""
        return self._cut(problems)

    def _cut(self, which: slice | Tensor) -> DriveObjective:
        cut = {
            f.name: getattr(self, f.name)[..., which] for f in fields(self) if f.name != "simulator"
        }
        return DriveObjective(self.simulator, **cut)

    @torch.no_grad()
    def __call__(self, candidates: Tensor) -> Tensor:
        """Returns losses `(P, q)`, m/s, of candidates `(P, q, n)` in unit space."""
        space = self.simulator.model.space
        p = {
            name: value.contiguous()
            for name, value in space.unpack(
                space.from_unit(candidates.to(self.observed.dtype))
            ).items()
        }
        shape = candidates.shape[:2]
        start = Start(
            *(
                x[:, None].expand(shape)
                for x in (self.start_position, self.start_speed, self.start_acceleration)
            )
        )
        leader = Leader(
            *(
                x[..., None]
                for x in (
                    self.leader_position,
                    self.leader_speed,
                    self.leader_acceleration,
                    self.leader_length,
                )
            )
        )
        _, _, speed = self.simulator.advance(self.simulator.begin(start), leader, p)
        error = (speed - self.observed[..., None]).square_() * self.counted[..., None]
        return (error.sum(0) / self.counted.sum(0)[:, None]).sqrt()


_TURN = 1 << 27
"""Most bytes that a joint objective simulates at once: 1 GB took three times as long as 256 MB, all of it in fetching pages."""


@dataclass(frozen=True)
class JointObjective:
    """One parameter set for many drives: the mean over the drives of each one's RMSE of speed.

    The mean of RMSEs, not the RMSE over all frames: every driver counts alike, and it is what an evaluation reports. Where all
    problems ask for the same candidates, as space-filling ones are, a drive that is in several of them is simulated once.

    Attributes:
        drives: D drives.
        members: the drives of each of K problems, bool `(K, D)`.
        memory: bound in bytes for what is simulated at once; candidates are taken in turns where all drives of all of them need
            more.
    """

    drives: DriveObjective
    members: Tensor
    memory: int

    @property
    def problems(self) -> int:
        """K."""
        return len(self.members)

    @property
    def bytes_per_candidate(self) -> int:
        """Memory that one candidate of one problem needs besides the turns, which are bounded: the drives' losses."""
        return 2 * self.members.shape[1] * self.drives.observed.element_size()

    def select(self, first: int, last: int) -> JointObjective:
        """Returns problems `first` to `last - 1`."""
        return replace(self, members=self.members[first:last])

    @torch.no_grad()
    def __call__(self, candidates: Tensor) -> Tensor:
        """Returns losses `(K, q)`, m/s, of candidates `(K, q, n)` in unit space."""
        problem, drive = self.members.nonzero().unbind(1)
        if bool((candidates == candidates[:1]).all()):
            used = self.members.any(0)
            simulated, place = used.nonzero()[:, 0], used.cumsum(0) - 1
            losses = self._simulated(simulated, torch.zeros_like(simulated), candidates)[
                place[drive]
            ]
        else:
            losses = self._simulated(drive, problem, candidates)
        total = losses.new_zeros(candidates.shape[:2]).index_add_(0, problem, losses)
        return total / self.members.sum(1, keepdim=True)

    def _simulated(self, drive: Tensor, problem: Tensor, candidates: Tensor) -> Tensor:
        """Returns the losses `(S, q)` of S simulations, each of a drive `(S,)` with a problem's candidates `(S,)`."""
        drives, count = self.drives.take(drive), candidates.shape[1]
        # The turns are small, but there are many: together they may be worth compiling for, which none of them is alone.
        drives = replace(
            drives, simulator=drives.simulator.for_work(len(drives.observed) * len(drive) * count)
        )
        turn = max(1, min(self.memory, _TURN) // (drives.bytes_per_candidate * len(drive)))
        return torch.cat(
            [drives(block[problem]) for block in torch.split(candidates, turn, dim=1)], dim=1
        )
