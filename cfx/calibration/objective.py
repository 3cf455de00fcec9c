"""What calibration minimises: how far a simulated drive is from the recorded one."""

from __future__ import annotations

from dataclasses import dataclass, fields

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
        cut = {f.name: getattr(self, f.name)[..., first:last] for f in fields(self) if f.name != "simulator"}
        return DriveObjective(self.simulator, **cut)

    @torch.no_grad()
    def __call__(self, candidates: Tensor) -> Tensor:
        """Returns losses `(P, q)`, m/s, of candidates `(P, q, n)` in unit space."""
        space = self.simulator.model.space
        p = {
            name: value.contiguous() for name, value in space.unpack(space.from_unit(candidates.to(self.observed.dtype))).items()
        }
        shape = candidates.shape[:2]
        start = Start(*(x[:, None].expand(shape) for x in (self.start_position, self.start_speed, self.start_acceleration)))
        leader = Leader(
            *(x[..., None] for x in (self.leader_position, self.leader_speed, self.leader_acceleration, self.leader_length))
        )
        _, _, speed = self.simulator.advance(self.simulator.begin(start), leader, p)
        error = (speed - self.observed[..., None]).square_() * self.counted[..., None]
        return (error.sum(0) / self.counted.sum(0)[:, None]).sqrt()


_TURN = 1 << 27
"""Most bytes that a joint objective simulates at once: 1 GB took three times as long as 256 MB, all of it in fetching pages."""


@dataclass(frozen=True)
class JointObjective:
    """One parameter set for many drives: the mean over the drives of each one's RMSE of speed.

    The mean of RMSEs, not the RMSE over all frames: every driver counts alike, and it is what an evaluation reports.

    Attributes:
        drives: D drives, those of problem 0 first, then those of problem 1 ...
        sizes: drives of each problem, `(K,)` int64, on the CPU; they sum to D.
        memory: bound in bytes for what is simulated at once; candidates are taken in turns where all drives of all of them need
            more.
    """

    drives: DriveObjective
    sizes: Tensor
    memory: int

    @property
    def problems(self) -> int:
        """K."""
        return len(self.sizes)

    @property
    def bytes_per_candidate(self) -> int:
        """Memory that one candidate of the largest problem needs."""
        return self.drives.bytes_per_candidate * int(self.sizes.max())

    def select(self, first: int, last: int) -> JointObjective:
        """Returns problems `first` to `last - 1`."""
        ends = [0, *self.sizes.cumsum(0).tolist()]
        return JointObjective(self.drives.select(ends[first], ends[last]), self.sizes[first:last], self.memory)

    @torch.no_grad()
    def __call__(self, candidates: Tensor) -> Tensor:
        """Returns losses `(K, q)`, m/s, of candidates `(K, q, n)` in unit space."""
        sizes = self.sizes.to(candidates.device)
        owner = torch.repeat_interleave(torch.arange(len(sizes), device=candidates.device), sizes)
        turn = max(1, min(self.memory, _TURN) // (self.drives.bytes_per_candidate * len(owner)))
        losses = torch.cat([self.drives(block[owner]) for block in torch.split(candidates, turn, dim=1)], dim=1)
        total = losses.new_zeros((len(sizes), losses.shape[1])).index_add_(0, owner, losses)
        return total / sizes[:, None]
