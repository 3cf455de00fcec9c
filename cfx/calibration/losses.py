"""Losses of simulated segments of trajectories, which a calibration minimises, and a prior on them.

Congested traffic says nothing of the speed that drivers want on a free road: any value beyond what
they reached fits as well, and a search returns whichever it met. With a weak prior such a parameter
stays near the model's default, and a parameter that the recording determines is hardly moved.

Shapes: P problems, q candidates of each, n tuned parameters, K steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from cfx.calibration.objectives import FrameValues, Objective
from cfx.core.parameters import squashed
from cfx.data.pairs import PairBatch
from cfx.models.base import Leader
from cfx.simulation.base import Stepper
from cfx.simulation.trajectory import ComponentKey, Segments, Start, Terms, common_shape

_WEAK = 0.01
"""The weak prior's weight: a parameter that is one unit of the squashed space away from its default
costs 1 % of the default's loss over n; 13 instead of 33 m/s, of 1 to 70, is 1.4 units away."""


def prior_weight(prior: str | float) -> float:
    """Returns the weight of `calibration.prior` on pooled parameters: the weak one, or none."""
    return 0.0 if prior == "none" else _WEAK


def prior_strength(
    prior: Literal["weak", "chosen", "none"] | float,
) -> float | Literal["chosen"] | None:
    """Returns the weight of `calibration.prior` on driver-specific parameters, or `chosen`.

    None: it is that of pooled ones.
    """
    if isinstance(prior, str):
        return "chosen" if prior == "chosen" else None
    return prior


@dataclass(frozen=True)
class Prior:
    """A penalty on the distance from a center in the squashed space, such as the model's default.

        loss + weight * (loss of the center) * mean((logit u - logit u_center)^2)

    It is the logarithm of a normal prior on each logit, up to constants; the center's loss gives
    it the objective's unit and makes it as strong for every driver.

    Attributes:
        center: what is likeliest, in the squashed space, `(n,)` or `(P, 1, n)`.
        weight: without unit.
        scale: the loss there in each problem, `(P, 1)`, in the objective's unit.
    """

    center: Tensor
    weight: float
    scale: Tensor

    @classmethod
    def of(
        cls, losses: Callable[[Tensor], Tensor], unit: Tensor, center: Tensor, weight: float
    ) -> Prior:
        """Returns the prior of P problems.

        Args:
            losses: of candidates `(P, q, n)`, without a prior.
            unit: what is likeliest, in unit space, `(P, 1, n)`.
            center: the same in the squashed space, `(n,)` or `(P, 1, n)`.
            weight: without unit.
        """
        return cls(center, weight, losses(unit).nan_to_num(nan=0.0, posinf=0.0))

    @property
    def bytes_per_candidate(self) -> int:
        """Memory that one candidate of one problem needs."""
        return 4 * torch.float64.itemsize * self.center.shape[-1]

    def cut(self, which: slice | Tensor) -> Prior:
        """Returns the prior of some of the problems."""
        center = self.center
        if center.dim() > 1:
            center = center[which]
        return replace(self, center=center, scale=self.scale[which])

    def penalty(self, candidates: Tensor) -> Tensor:
        """Returns what is added to the losses of candidates `(P, q, n)`, `(P, q)`."""
        if candidates.stride(0) == 0:  # shared by all problems: an expanded view
            candidates = candidates[:1]
        away = squashed(candidates) - self.center.to(candidates)
        return self.weight * self.scale * away.square().mean(-1)


@dataclass(frozen=True)
class SegmentLosses:
    """Losses of P segments simulated in closed loop, for q candidate parameter sets each.

    Each segment starts from a measured state behind its measured leader and lasts up to K steps.

    Attributes:
        stepper: the model and its time step.
        objective: compares the simulated segment with the measured one.
        segments: what was measured, K steps of P segments.
        prior: added to the losses of candidates in unit space; None: none.
    """

    stepper: Stepper
    objective: Objective
    segments: Segments
    prior: Prior | None = None

    @classmethod
    def of_segments(
        cls,
        stepper: Stepper,
        objective: Objective,
        batch: PairBatch,
        pair: Tensor,
        first: Tensor,
        steps: Tensor,
    ) -> SegmentLosses:
        """Cuts segments out of pairs.

        Args:
            stepper: the model and its time step.
            objective: compares the simulated segments with the measured ones.
            batch: the pairs.
            pair: `(P,)`, index of each segment's pair in the batch.
            first: `(P,)`, frame at which the segment starts (the measured state).
            steps: `(P,)`, steps to simulate; frames `first + 1` to `first + steps` are compared.
        """
        k = torch.arange(int(steps.max()), device=pair.device)[:, None]
        now = (first + k).clamp(max=batch.mask.shape[1] - 1)
        after = (now + 1).clamp(max=batch.mask.shape[1] - 1)
        leader_rear = batch.leader_position[pair, after] - batch.leader_length[pair]
        segments = Segments(
            leader_position=batch.leader_position[pair, now],
            leader_speed=batch.leader_speed[pair, now],
            leader_acceleration=batch.leader_acceleration[pair, now],
            leader_rear=leader_rear,
            measured_speed=batch.follower_speed[pair, after],
            measured_gap=leader_rear - batch.follower_position[pair, after],
            counted=(k < steps).to(batch.follower_speed.dtype),
            leader_length=batch.leader_length[pair],
            position=batch.follower_position[pair, first],
            speed=batch.follower_speed[pair, first],
            acceleration=batch.follower_acceleration[pair, first],
        )
        return cls(stepper, objective, segments)

    @property
    def problems(self) -> int:
        """P."""
        return len(self.segments.leader_length)

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.segments.leader_length.device

    @property
    def steps(self) -> int:
        """K."""
        return len(self.segments.measured_speed)

    @property
    def bytes_per_candidate(self) -> int:
        """Memory that one candidate of one problem needs.

        Without trajectories: its parameters, in unit space and not, the sums and the loss. Else
        positions, speeds, a term, its masked copy and the intermediate values of one step; a gap
        is another value with another term.
        """
        parameters = len(self.stepper.model.space.names)
        if self.accumulates:
            values = 3 * parameters + 8
        elif "gap" in self.objective.signals:
            values = 6 * self.steps + 32
        else:
            values = 4 * self.steps + 32
        size = values * self.segments.measured_speed.element_size()
        if self.prior is not None:
            size += self.prior.bytes_per_candidate
        return size

    @property
    def accumulates(self) -> bool:
        """Whether losses come from a compiled kernel, given enough work, without trajectories."""
        space = self.stepper.model.space
        defaults = space.to_unit(space.defaults()).to(self.device)
        return self.stepper.accumulates(self.parameters(defaults[None, None]), self.terms)

    def for_work(self, candidates: int) -> SegmentLosses:
        """Returns the same losses, for a number of candidates of each problem in all calls."""
        steps = self.problems * self.steps * candidates
        return replace(self, stepper=self.stepper.for_work(steps))

    def rough(self) -> SegmentLosses:
        """Returns the same losses in float32: kernels take half the time."""
        segments = Segments(*(values.float() for values in self.segments))
        return replace(self, segments=segments)

    def take(self, problems: slice | Tensor) -> SegmentLosses:
        """Returns the problems of numbers `(S,)` int64; one may stand there more than once."""
        segments = Segments(*(values[..., problems] for values in self.segments))
        if self.prior is None:
            return replace(self, segments=segments)
        return replace(self, segments=segments, prior=self.prior.cut(problems))

    @torch.no_grad()
    def __call__(self, candidates: Tensor | Mapping[str, Tensor]) -> Tensor:
        """Returns losses `(P, q)`, in the objective's unit.

        Args:
            candidates: `(P, q, n)` in unit space; or one tensor per parameter, in SI units, `()` or
                broadcasting to `(P, q)`, to which the prior is not applied.
        """
        if isinstance(candidates, Tensor):
            # Candidates that all problems share, an expanded view, are converted once.
            if candidates.stride(0) == 0:
                candidates = candidates[:1]
            p: Mapping[str, Tensor] = self.parameters(candidates)
        else:
            p = candidates
        counted = self.segments.counted
        sums = self.stepper.accumulate(self.segments, p, self.terms)
        if sums is not None:
            losses = self.objective.finish(sums, counted.sum(0).clamp(min=1)[:, None])
        else:
            frames = self.simulated(p, gap="gap" in self.objective.signals)
            losses = self.objective(frames, counted[..., None])
        if self.prior is None or not isinstance(candidates, Tensor):
            return losses
        return losses + self.prior.penalty(candidates)

    def simulated(self, p: Mapping[str, Tensor], *, gap: bool) -> FrameValues:
        """Returns frames 1 to K: simulated signals `(K, P, q)` and measured ones `(K, P, 1)`.

        Args:
            p: one tensor per parameter, in SI units, `()` or broadcasting to `(P, q)`.
            gap: compute the simulated gap; without, it is NaN.
        """
        s = self.segments
        shapes: list[tuple[int, ...]] = [(self.problems, 1)]
        for value in p.values():
            shapes.append(tuple(value.shape))
        shape = common_shape(shapes)
        start = Start(
            s.position[:, None].expand(shape),
            s.speed[:, None].expand(shape),
            s.acceleration[:, None].expand(shape),
        )
        # One leader for all candidates: (K, P, 1) broadcasts to (K, P, q) without a copy.
        leader = Leader(
            s.leader_position[..., None],
            s.leader_speed[..., None],
            s.leader_acceleration[..., None],
            s.leader_length[..., None],
        )
        _, position, speed = self.stepper.advance(self.stepper.begin(start), leader, p)
        simulated_gap = speed.new_tensor(torch.nan)
        if gap:
            simulated_gap = s.leader_rear[..., None] - position
        return FrameValues(
            speed=speed,
            gap=simulated_gap,
            measured_speed=s.measured_speed[..., None],
            measured_gap=s.measured_gap[..., None],
            dt=self.stepper.dt,
        )

    @property
    def terms(self) -> Terms:
        """What one frame adds to the sums of the objective."""

        def of_frame(
            v: Tensor, gap: Tensor, v_real: Tensor, gap_real: Tensor
        ) -> tuple[Tensor, ...]:
            return self.objective.terms(FrameValues(v, gap, v_real, gap_real, self.stepper.dt))

        settings = self.objective.settings.model_dump_json()
        return Terms(of_frame, ComponentKey(type(self.objective), settings))

    def parameters(self, candidates: Tensor) -> dict[str, Tensor]:
        """Returns candidates `(P, q, n)` in unit space as one tensor per parameter, SI units."""
        space = self.stepper.model.space
        values = space.from_unit(candidates.to(self.segments.measured_speed.dtype))
        return {name: value.contiguous() for name, value in space.unpack(values).items()}


@dataclass(frozen=True)
class TrajectorySegments:
    """Segments of pairs, which are cut out where they are simulated.

    Each starts from a measured state, and the next one of the pair where it ends.

    Attributes:
        stepper: the model and its time step.
        objective: compares the simulated segments with the measured ones.
        batch: P pairs.
        pair: `(D,)`, index of each segment's pair in the batch.
        first: `(D,)`, frame at which the segment starts.
        last: `(D,)`, the last frame that is compared.
        weight: `(D,)`, 1 over the number of the pair's segments: every pair counts alike.
    """

    stepper: Stepper
    objective: Objective
    batch: PairBatch
    pair: Tensor
    first: Tensor
    last: Tensor
    weight: Tensor

    @classmethod
    def of_pairs(
        cls,
        stepper: Stepper,
        objective: Objective,
        batch: PairBatch,
        last: Tensor,
        length: int | None = None,
    ) -> TrajectorySegments:
        """Cuts pairs, from frame 0 to their last one.

        Args:
            stepper: the model and its time step.
            objective: compares the simulated segments with the measured ones.
            batch: P pairs.
            last: `(P,)`, the last frame that is compared.
            length: steps of each segment. A pair that is no multiple of it is cut into as many as
                come nearest, of about the same length, so that no remainder is left out or
                compared after less time than the others. None: pairs stay whole.
        """
        pieces = torch.ones_like(last)
        if length is not None:
            pieces = (last / length).round().long().clamp(min=1)
        pair = torch.arange(len(last), device=last.device).repeat_interleave(pieces)
        number = torch.arange(len(pair), device=last.device) - (pieces.cumsum(0) - pieces)[pair]
        first = number * last[pair] // pieces[pair]
        end = (number + 1) * last[pair] // pieces[pair]
        weight = 1.0 / pieces[pair].double()
        return cls(stepper, objective, batch, pair, first, end, weight)

    @property
    def problems(self) -> int:
        """D."""
        return len(self.pair)

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.pair.device

    @property
    def steps(self) -> int:
        """K, of the longest segment."""
        return int((self.last - self.first).max())

    def take(self, problems: Tensor) -> SegmentLosses:
        """Returns segments of numbers `(S,)` int64; one may stand there more than once."""
        return SegmentLosses.of_segments(
            self.stepper,
            self.objective,
            self.batch,
            self.pair[problems],
            self.first[problems],
            (self.last - self.first)[problems],
        )


_BYTES_AT_ONCE = 1 << 27
"""Most bytes that pooled losses simulate at once. 1 GB took three times as long as 256 MB, all of
it in fetching pages."""

_SUMMED_AT_ONCE = 1 << 25
"""The same where a kernel sums up losses without trajectories: what it writes is freed and written
again, and stays in the process's own memory (`cfx.core.memory`)."""

_SEGMENTS_AT_ONCE = 1024
"""Segments that are simulated for a shard of candidates: memory does not grow with their number,
and the shard has many candidates."""

_VECTOR = 32
"""Shards of candidates are multiples of this, the number that the kernel simulates together."""


@dataclass(frozen=True)
class PooledLosses:
    """The mean loss over many segments, for one parameter set that is shared by all of them.

    The mean of losses, not the loss over all frames: every driver counts alike, and the mean over
    whole trajectories is what an evaluation reports. A segment that belongs to several problems is
    simulated once, for the candidates of all of them, or once for all where these are the same, as
    space-filling ones are.

    Attributes:
        segments: D segments.
        members: the segments of each of K problems, bool `(K, D)`.
        memory: bound in bytes for what is simulated at once; candidates are simulated in shards
            where all segments of all of them need more.
        weight: how much each segment counts, `(D,)`; None: all alike.
        prior: added to the losses; None: none.
    """

    segments: SegmentLosses | TrajectorySegments
    members: Tensor
    memory: int
    weight: Tensor | None = None
    prior: Prior | None = None

    @property
    def problems(self) -> int:
        """K."""
        return len(self.members)

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.segments.device

    @property
    def bytes_per_candidate(self) -> int:
        """Memory of one candidate of one problem besides the shards: the sum and the mean."""
        size = 2 * torch.float64.itemsize
        if self.prior is not None:
            size += self.prior.bytes_per_candidate
        return size

    def for_work(self, candidates: int) -> PooledLosses:
        """Returns the same losses, for a number of candidates of each problem in all calls."""
        simulated = int(self.members.sum()) * self.segments.steps
        stepper = self.segments.stepper.for_work(simulated * candidates)
        return replace(self, segments=replace(self.segments, stepper=stepper))

    def take(self, problems: slice | Tensor) -> PooledLosses:
        """Returns some of the problems."""
        members = self.members[problems]
        if self.prior is None:
            return replace(self, members=members)
        return replace(self, members=members, prior=self.prior.cut(problems))

    def rough(self) -> PooledLosses:
        """Returns itself."""
        return self

    @torch.no_grad()
    def __call__(self, candidates: Tensor) -> Tensor:
        """Returns losses `(K, q)`, in the objective's unit, of candidates `(K, q, n)`."""
        shared = bool((candidates == candidates[:1]).all())
        used = self.members.any(0).nonzero()[:, 0]
        # Shards are small, but there are many: together they may be worth compiling for, which none
        # of them is alone.
        simulated = int(self.members.sum())
        if shared:
            simulated = len(used)
        work = self.segments.steps * simulated * candidates.shape[1]
        stepper = self.segments.stepper.for_work(work)
        segments = replace(self.segments, stepper=stepper)
        total = candidates.new_zeros(candidates.shape[:2])
        for numbers in torch.split(used, _SEGMENTS_AT_ONCE):
            if shared:
                self._add_shared(segments, numbers, total, candidates[:1])
            else:
                self._add(segments, numbers, total, candidates)
        counts = self.members
        if self.weight is not None:
            counts = counts * self.weight
        losses = total / counts.sum(1, keepdim=True)
        if self.prior is None:
            return losses
        return losses + self.prior.penalty(candidates)

    def _add_shared(
        self,
        segments: SegmentLosses | TrajectorySegments,
        numbers: Tensor,
        total: Tensor,
        candidates: Tensor,
    ) -> None:
        """Adds the losses of segments for candidates `(1, q, n)` that all problems have.

        Args:
            segments: all of them.
            numbers: of those whose losses are added.
            total: sums of losses `(K, q)`, changed in place.
            candidates: each is simulated once, whichever problems a segment belongs to.
        """
        problem, place = self.members[:, numbers].nonzero().unbind(1)
        losses_of = segments.take(numbers)
        for columns, shard in self._shards(losses_of, len(numbers), total, candidates):
            losses = losses_of(shard.expand(len(numbers), -1, -1)).to(total)
            columns.index_add_(0, problem, self._weighted(losses[place], numbers[place]))

    def _add(
        self,
        segments: SegmentLosses | TrajectorySegments,
        numbers: Tensor,
        total: Tensor,
        candidates: Tensor,
    ) -> None:
        """As `_add_shared`, for candidates `(K, q, n)` of each problem's own."""
        members = self.members[:, numbers]
        problem, place = members.nonzero().unbind(1)
        groups = _by_problems(members)
        losses_of = [segments.take(numbers[group.places]) for group in groups]
        for columns, shard in self._shards(losses_of[0], len(place), total, candidates):
            width = shard.shape[1]
            losses = columns.new_empty((len(place), width))
            for losses_of_group, group in zip(losses_of, groups, strict=True):
                # (G, m, q, n) -> (G, m q, n): a segment is simulated once for all its problems.
                of_group = losses_of_group(shard[group.problems].flatten(1, 2)).to(total)
                losses[group.members] = of_group.reshape(*group.problems.shape, width)
            columns.index_add_(0, problem, self._weighted(losses, numbers[place]))

    def _weighted(self, losses: Tensor, segments: Tensor) -> Tensor:
        """Returns losses `(S, q)` of segments of numbers `(S,)` as much as they count."""
        if self.weight is None:
            return losses
        return losses * self.weight[segments, None]

    def _shards(
        self, segments: SegmentLosses, simulated: int, total: Tensor, candidates: Tensor
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yields columns of `total` `(K, q)` with their candidates, of `(K, q, n)` or `(1, q, n)`.

        `simulated` segments are simulated at once for one candidate of each problem.
        """
        bound = min(self.memory, _BYTES_AT_ONCE)
        if segments.accumulates:
            bound = min(self.memory, _SUMMED_AT_ONCE)
        size = max(1, bound // (segments.bytes_per_candidate * simulated))
        if size > _VECTOR:
            size -= size % _VECTOR
        columns = torch.split(total, size, dim=1)
        yield from zip(columns, torch.split(candidates, size, dim=1), strict=True)


class _SegmentGroup(NamedTuple):
    """Segments that belong to equally many problems, m.

    Each is simulated once, for the candidates of all its problems: it is read once, and the kernel
    fills its vectors although each problem may ask for few candidates.

    Attributes:
        places: `(G,)`, of the segments.
        problems: `(G, m)`, those that each belongs to.
        members: `(G, m)`, which number these have among all memberships, problem by problem.
    """

    places: Tensor
    problems: Tensor
    members: Tensor


def _by_problems(members: Tensor) -> list[_SegmentGroup]:
    """Groups segments by the number of their problems, of memberships bool `(K, S)`."""
    number = members.flatten().cumsum(0).reshape(members.shape) - 1
    counts = members.sum(0)
    groups = []
    for count in sorted(set(counts.tolist())):
        places = (counts == count).nonzero()[:, 0]
        problems = members[:, places].T.nonzero()[:, 1].reshape(len(places), count)
        groups.append(_SegmentGroup(places, problems, number[problems, places[:, None]]))
    return groups
