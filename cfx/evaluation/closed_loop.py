"""The closed loop: a policy chooses parameters, the model drives with them, and the policy sees what came of it.

From the last measured state before the test part on, the follower is simulated against the measured leader; the policy sees the
*simulated* follower, never the measured one. Before that it has read the measured history of the training part.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cfx.models.base import Leader
from cfx.pairs import PairBatch
from cfx.policies.features import History
from cfx.policies.trained import TrainedPolicy
from cfx.simulation.base import BaseSimulator
from cfx.simulation.rollout import Start
from cfx.simulation.threads import one_thread


class ClosedLoop(NamedTuple):
    """P closed-loop drives, frame 0 being the last measured state; SI units.

    Attributes:
        speed, gap: `(P, K + 1)`.
        parameters: `(P, K + 1, n)`, what held on the way to each frame (at frame 0: what holds next).
        counted: `(P, K + 1)` bool, frames within the recording; frame 0 does not count.
    """

    speed: Tensor
    gap: Tensor
    parameters: Tensor
    counted: Tensor


@torch.no_grad()
@one_thread()
def drive(
    simulator: BaseSimulator,
    policy: TrainedPolicy,
    batch: PairBatch,
    first: Tensor,
    network: Tensor,
    *,
    base: Tensor | None = None,
    history: float | None = None,
) -> ClosedLoop:
    """Lets a policy drive the test part of P pairs.

    Args:
        simulator: the model and its time step.
        policy: chooses the parameters of each window.
        batch: P pairs, whole.
        first: `(P,)`, the frame of the last measured state.
        network: `(P,)`, which of the policy's networks drives each pair.
        base: `(P, n)` in SI units, what a policy's offsets are from; None: the policy's own base.
        history: seconds of measured history before `first` that the policy reads, and from which the driver's driver features are
            measured; None: all there is.
    """
    length, stride = policy.windows.length, policy.windows.stride
    steps = int((batch.lengths - 1 - first).max())
    frames = first[:, None] + torch.arange(1 - length, steps + 1, device=first.device)
    index = frames.clamp(min=0, max=batch.mask.shape[1] - 1)
    leader_position, leader_speed, leader_acceleration = (
        signal.gather(1, index)
        for signal in (batch.leader_position, batch.leader_speed, batch.leader_acceleration)
    )
    # Columns of these buffers: `length - 1` measured frames, frame 0, and then what is simulated.
    position = batch.follower_position.gather(1, index)
    speed = batch.follower_speed.gather(1, index)
    acceleration = batch.follower_acceleration.gather(1, index)
    now = length - 1
    for buffer in (position, speed, acceleration):
        buffer[:, now + 1 :] = torch.nan  # nothing measured may be seen from here on
    since = None if history is None else (first - round(history / simulator.dt)).clamp(min=0)
    state = policy.read(
        batch,
        first,
        policy.begin(network, base, policy.driver_features_of(batch, first, since)),
        since,
    )
    follower = simulator.begin(Start(position[:, now], speed[:, now], acceleration[:, now]))
    parameters = speed.new_empty((len(batch), steps + 1, len(policy.space)))
    gap = leader_position - batch.leader_length[:, None] - position
    for begin in range(0, steps, stride):
        end = min(begin + stride, steps)
        recent = slice(begin, begin + length)
        seen = History(
            leader_speed[:, recent],
            leader_acceleration[:, recent],
            speed[:, recent],
            acceleration[:, recent],
            gap[:, recent],
        )
        chosen, state = policy.act(seen, state)
        ahead = slice(now + begin, now + end)
        leader = Leader(
            leader_position[:, ahead].T,
            leader_speed[:, ahead].T,
            leader_acceleration[:, ahead].T,
            batch.leader_length,
        )
        follower, positions, speeds = simulator.advance(
            follower, leader, policy.space.unpack(chosen)
        )
        done = slice(now + begin + 1, now + end + 1)
        position[:, done] = positions.T
        speed[:, done] = speeds.T
        acceleration[:, done] = (speed[:, done] - speed[:, now + begin : now + end]) / simulator.dt
        gap[:, done] = leader_position[:, done] - batch.leader_length[:, None] - position[:, done]
        parameters[:, begin + 1 : end + 1] = chosen[:, None]
        if begin == 0:
            parameters[:, 0] = chosen
    counted = frames[:, now:] < batch.lengths[:, None]
    counted[:, 0] = False
    return ClosedLoop(speed[:, now:], gap[:, now:], parameters, counted)
