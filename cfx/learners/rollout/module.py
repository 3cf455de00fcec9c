"""Training of a shard of networks, wherever it is: gradient steps, schedules, and validation.

Importing this imports Lightning, which takes seconds and 100 MB.

Shapes: N networks (each member of an ensemble counts), D trajectories of each.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor
from torch.utils.data import DataLoader

from cfx.core.engine import Report
from cfx.learners.batched import BatchedModule, fit
from cfx.learners.rollout import equilibrium
from cfx.learners.rollout.dataset import RolloutBatch, RolloutDataset
from cfx.learners.rollout.equilibrium import SteadySampler
from cfx.learners.rollout.loop import CompiledLoop, Expert, simulate
from cfx.learners.rollout.loss import Divisors, FrameWeights, TrajectoryLoss
from cfx.learners.rollout.sampling import TrajectorySampler
from cfx.learners.rollout.settings import RolloutSettings
from cfx.learners.rollout.shard import TrainedShard, TrainingShard, untrained
from cfx.learners.rollout.window import GradientPath, Segment, WindowStep
from cfx.policies.core import AgentCore
from cfx.simulation.kernel.columns import Unsupported
from cfx.simulation.rollout import can_compile

log = logging.getLogger(__name__)

_WORTH_COMPILING = 5_000
"""Windows simulated in training, one after the other, from which compiling pays: some ten
seconds of eager work."""

_LEAST_TEMPERATURE = 0.02
"""Below this a smoothed switch has no gradient that single precision resolves."""

DISPERSIONS = (0.5, 4.0)
"""Least and greatest factor on the noise of a stochastic head."""

_HALVINGS = 5
"""Of the logarithm between `DISPERSIONS`, which leave 6 % of a factor."""

_STARTS = (0.8, 0.9)
"""Shares of a validation trajectory from which these paths are sampled. Most protocols calibrate
driver-specific parameters on the part before, where networks are surer."""

_COVERING = 19
"""Number of sampled paths whose range covers 90 % of calibrated outcomes: an outcome exchangeable
with 19 paths is the least or the greatest of the twenty in two cases of twenty."""

_TOGETHER = 4_000
"""Trajectories of these paths that are simulated at once, which bounds the memory."""

_COVERED = (_COVERING - 1) / (_COVERING + 1)
"""Share of outcomes that lie within the range of so many paths, if the paths are drawn as they are:
1 minus two cases of twenty."""

_WARM_UP = 20
"""Gradient steps over which the learning rate rises."""


class RolloutModule(BatchedModule):
    """Trains N networks on random trajectories in closed loop.

    Args:
        shard: the networks, and what they learn from.
        expert: networks to imitate in the first `settings.distillation_epochs` epochs.
        on_epoch: called after each epoch.
    """

    settings: RolloutSettings

    def __init__(
        self,
        shard: TrainingShard,
        expert: Expert | None = None,
        on_epoch: Callable[[], None] = lambda: None,
    ) -> None:
        settings, dataset, training_data = shard.settings, shard.dataset, shard.training_data
        head, size, device = shard.head, dataset.ensemble_size, dataset.base.device
        network = untrained(shard.policy, dataset, head, torch.Generator())
        network.load_state_dict(shard.weights)
        super().__init__(network, training_data.names, settings, on_epoch, ensemble_size=size)
        self.shard, self.expert = shard, expert
        windows, dt = training_data.windows, training_data.stepper.dt
        model = head.driven_model(training_data.stepper.model)
        core = AgentCore(shard.policy, network, dataset.scaler, head)
        self.temperature = torch.tensor(settings.temperature, device=device)
        self.exact_step = WindowStep(core, model, windows, dt)
        if settings.temperature > 0:
            model = model.at_temperature(self.temperature)
        self.training_window = WindowStep(core, model, windows, dt)
        self.compiled: dict[WindowStep, CompiledLoop] = {}
        if self._is_worth_compiling():
            self._compile()
        self.loss = TrajectoryLoss(training_data.objective, settings, dt)
        self.sampler = TrajectorySampler(
            dataset,
            settings,
            windows.stride,
            has_cold_starts=training_data.pairs.base is not None,
            seed=training_data.seed,
        )
        if settings.time_weighting == "relative":
            self.loss.frame_weights = self._frame_weights()
        clip = settings.gradient_clip_state / self.sampler.trajectories
        self.through_time = GradientPath(settings.gradient_decay, clip, settings.tbptt_windows)
        self.steady: SteadySampler | None = None
        if shard.equilibrium is not None:
            self.steady = SteadySampler(
                dataset,
                shard.equilibrium,
                settings.equilibrium_s,
                windows.stride,
                windows.length,
            )
        self.losses: list[Tensor] = []
        self._noise_of = 0  # the gradient step whose noise is drawn
        self.dispersion = torch.ones(len(dataset.pair), device=device)

    @property
    def dataset(self) -> RolloutDataset:
        """The drivers of the networks."""
        return self.shard.dataset

    def train_dataloader(self) -> DataLoader[Any]:
        """Returns the numbers of an epoch's gradient steps; what is sampled follows from them."""
        numbers: Any = range(self.settings.steps)
        return DataLoader(numbers, batch_size=None, generator=self.loaders_generator)

    def configure_optimizers(self) -> Any:
        optimizer = super().configure_optimizers()
        return [optimizer], [torch.optim.lr_scheduler.LambdaLR(optimizer, self._rate)]

    def on_train_epoch_start(self) -> None:
        s = self.settings
        done = self.current_epoch / max(1, s.epochs - 1)
        temperature = s.temperature + done * (s.temperature_end - s.temperature)
        self.temperature.fill_(max(temperature, _LEAST_TEMPERATURE))
        if self.is_stochastic and self.current_epoch == self.first_sampled_epoch:
            self.forget_best()

    def training_step(self, number: int, index: int) -> None:
        optimizer, schedule = self.optimizers(), self.lr_schedulers()
        assert isinstance(optimizer, LightningOptimizer)
        assert isinstance(schedule, torch.optim.lr_scheduler.LambdaLR)
        step = self.current_epoch * self.settings.steps + int(number)
        self.generator.manual_seed(self.sampler.step_seed(step))  # for dropout
        optimizer.zero_grad()
        total = torch.zeros(len(self.dataset.pair), device=self.dataset.pair.device)
        for loss in self.step_losses(step):
            self.manual_backward(loss.sum())
            total += loss.detach()
        self.configure_gradient_clipping(optimizer)
        optimizer.step()
        schedule.step()
        self.losses.append(total.cpu())

    def step_losses(self, step: int) -> Iterator[Tensor]:
        """Yields each network's loss in a gradient step, `(N,)`, of each segment."""
        batch = self.sampler.training(step)
        self._noise_of = step
        count = batch.weight.sum(1).clamp(min=1.0)
        divisors = self.shard.errors.over_horizon(batch)
        expert, path = None, self.through_time
        if self.expert is not None and self.current_epoch < self.settings.distillation_epochs:
            expert, path = self.expert, replace(path, through_motion=False)
        segments = self.simulated(self.training_window, batch, self.settings.horizon, path, expert)
        for segment in segments:
            loss = self.trajectory_loss(segment, divisors)
            yield (loss * batch.weight).sum(1) / count
        if self.steady is not None and expert is None:
            yield self._steady_loss(step)

    def simulated(
        self,
        step: WindowStep,
        batch: RolloutBatch,
        windows: int,
        path: GradientPath | None = None,
        expert: Expert | None = None,
    ) -> Iterator[Segment]:
        """Simulates trajectories, segment by segment, as `simulate` does.

        With a head that draws, `settings.paths` sampled paths of all trajectories stand behind the
        path of the centre. In the first half of the epochs of training there are none: with noise
        from the start, Krauss's model is not trained.

        Args:
            step: simulates one window.
            batch: the trajectories.
            windows: how many each lasts.
            path: the way that gradients take back; None: none, and all history is observed.
            expert: networks to imitate; None: none.
        """
        noise = None
        if self.samples_paths and expert is None:
            noise = self._noise(batch, windows, self.settings.paths)
            of_centre = torch.zeros_like(noise[:, :, : batch.place.shape[1]])
            noise = torch.cat([of_centre, noise], 2)
        burn_in_windows = None
        if path is not None:
            burn_in_windows = self.burn_in_windows
        return simulate(
            step,
            self.dataset,
            batch,
            windows,
            path,
            burn_in_windows=burn_in_windows,
            expert=expert,
            noise=noise,
            compiled=self.compiled.get(step),
        )

    def trajectory_loss(self, segment: Segment, divisors: Divisors) -> Tensor:
        """Returns the loss of each trajectory over a segment, `(N, D)`.

        The loss of sampled paths, where the segment has any, is added to that of the centre's.

        Args:
            segment: `(N, (1 + paths) D, frames)`, as `simulated` gives it.
            divisors: of the losses, `(N, D)` each.
        """
        count = divisors.objective.shape[1]
        loss = self.loss(segment.only(slice(count)), divisors)
        paths = segment.speed.shape[1] // count - 1
        if paths > 0:
            others = segment.only(slice(count, None))
            loss = loss + self.loss.of_paths(others, divisors, paths)
        return loss

    def _steady_loss(self, step: int | None) -> Tensor:
        """Returns the weighted error of the gaps at which drivers settle, `(N,)`.

        Args:
            step: number of the gradient step; None: of validation, without gradients.
        """
        assert self.steady is not None
        s = self.settings
        if step is None:
            steady, window, path = self.steady.validation(), self.exact_step, None
        else:
            generator = torch.Generator().manual_seed(self.sampler.step_seed(step))
            steady, window = self.steady.training(generator), self.training_window
            clip = s.gradient_clip_state / steady.target.shape[1]
            path = GradientPath(equilibrium.DECAY, clip)
        segment = next(
            simulate(
                window,
                steady.dataset,
                steady.batch,
                self.steady.windows,
                path,
                compiled=self.compiled.get(window),
            )
        )
        return s.equilibrium_weight * steady.loss(segment)

    def curves(self) -> pd.DataFrame:
        """As `BatchedModule.curves`.

        With a head that draws, the column `sampled_paths` says of how many paths of each trajectory
        the CRPS is in the training loss of an epoch; in the validation loss it always is.
        """
        curves = super().curves()
        if self.is_stochastic:
            samples = curves["epoch"] >= self.first_sampled_epoch
            curves["sampled_paths"] = samples * self.settings.paths
        return curves

    @property
    def samples_paths(self) -> bool:
        """Whether paths are sampled: in validation always, in training from half the epochs on."""
        if not self.is_stochastic:
            return False
        return not torch.is_grad_enabled() or self.current_epoch >= self.first_sampled_epoch

    @property
    def is_stochastic(self) -> bool:
        """Whether the head draws."""
        return self.exact_step.core.head.noise_width > 0

    @property
    def first_sampled_epoch(self) -> int:
        """The first epoch in which training samples paths, where the head draws."""
        return self.settings.epochs // 2

    def _noise(self, batch: RolloutBatch, windows: int, paths: int) -> Tensor:
        """Returns what sampled paths draw from, `(windows, N, paths D, k)`.

        In training it follows from the gradient step; in validation it is always the same.
        """
        dataset = self.dataset
        count, width = batch.place.shape[1], self.exact_step.core.head.noise_width
        most = max(count, self.sampler.trajectories)
        generator = torch.Generator().manual_seed(self.sampler.step_seed(self._noise_of))
        drawn = dataset.normal((windows, paths, most, width), generator)[:, :, :, :count]
        drawn = drawn * self.dispersion.view(-1, 1, 1, 1, 1)
        return drawn.flatten(2, 3).transpose(0, 1).contiguous()

    @torch.no_grad()
    def fit_dispersion(self) -> Tensor | None:
        """Returns a factor on each network's noise, `(N,)`; None for a head without noise.

        With it the range of sampled paths holds as many of the speeds of validation drivers as it
        should: networks are surer of drivers that they learned from than of others. 1 where none
        was kept.
        """
        if not self.is_stochastic:
            return None
        batch = self.sampler.validation_with_history(_STARTS)
        if not bool((batch.weight > 0).any()):
            return self.dispersion.clone()
        least = torch.full_like(self.dispersion, math.log(DISPERSIONS[0]))
        greatest = torch.full_like(self.dispersion, math.log(DISPERSIONS[1]))
        for _ in range(_HALVINGS):
            middle = 0.5 * (least + greatest)
            self.dispersion.copy_(middle.exp())
            too_wide = self._coverage(batch) > _COVERED
            greatest = torch.where(too_wide, middle, greatest)
            least = torch.where(too_wide, least, middle)
        self.dispersion.fill_(1.0)
        keeps_drivers = (batch.weight > 0).any(1)
        return torch.where(keeps_drivers, (0.5 * (least + greatest)).exp(), 1.0)

    def _coverage(self, batch: RolloutBatch) -> Tensor:
        """Returns the share of speeds within the range of sampled paths, `(N,)`.

        The first window does not count, in which hardly anything is left to chance.
        """
        windows, step = self.settings.horizon, self.exact_step
        networks, count = batch.place.shape
        together = max(1, _TOGETHER // (networks * count))
        lows, highs = [], []
        for first in range(0, _COVERING, together):
            self._noise_of = first
            paths = min(together, _COVERING - first)
            noise = self._noise(batch, windows, paths)
            segment = next(simulate(step, self.dataset, batch, windows, noise=noise))
            speed = segment.speed.view(networks, paths, count, -1)
            lows.append(speed.amin(1))
            highs.append(speed.amax(1))
        low, high = torch.stack(lows).amin(0), torch.stack(highs).amax(0)
        measured = segment.only(slice(count)).measured
        within = (low <= measured.speed) & (measured.speed <= high)
        weight = measured.counted * batch.weight[..., None]
        later = slice(step.stride, None)
        return (within * weight)[..., later].sum((1, 2)) / weight[..., later].sum((1, 2))

    @torch.no_grad()
    def _frame_weights(self) -> FrameWeights:
        """Returns weights relative to the errors of each untrained network."""
        batch = self.sampler.training(0)
        windows = self.settings.horizon
        segment = next(simulate(self.exact_step, self.dataset, batch, windows))
        weight = segment.measured.counted * batch.weight[..., None]
        count = weight.sum(1, keepdim=True).clamp(min=1.0)
        speed = (segment.speed - segment.measured.speed).square() * weight
        gap = (segment.gap - segment.measured.gap).square() * weight
        return FrameWeights.relative_to(
            speed.sum(1, keepdim=True) / count, gap.sum(1, keepdim=True) / count
        )

    @property
    def burn_in_windows(self) -> int | None:
        """How many windows of history a policy observes at most in training; None: all."""
        burn_in_s = self.settings.burn_in_s
        if burn_in_s is None:
            return None
        step = self.training_window
        return max(1, round(burn_in_s / (step.stride * step.dt)))

    @torch.no_grad()
    def validation_step(self, number: int, index: int) -> None:
        train = torch.stack(self.losses).mean(0)
        self.losses.clear()
        is_hopeful = self.current_epoch < self.settings.distillation_epochs
        if self.is_stochastic:
            is_hopeful |= self.current_epoch < self.first_sampled_epoch
        self.judge(train, self.validation_loss().cpu(), hopeful=is_hopeful)

    def validation_loss(self) -> Tensor:
        """Returns the loss of validation with the exact model, `(N,)`.

        The error of the gaps at which drivers settle is part of it where it is part of training.
        NaN for a network that keeps no driver for validation. Cold starts count as much as they do
        in training, where a network keeps whole trajectories.
        """
        loss = self._trajectories_loss()
        if self.steady is not None:
            loss = loss + self._steady_loss(None)
        return loss

    def _trajectories_loss(self) -> Tensor:
        """Returns the loss of validation trajectories, `(N,)`."""
        sampler = self.sampler
        if sampler.validation_places.shape[1] == 0:
            return torch.full((len(sampler.validation_places),), torch.nan)
        share = sampler.cold_start_fraction
        if share == 0:
            return self._loss_with_history()
        cold = self._loss_of_cold_starts()
        if share == 1 and not bool(cold.isnan().any()):
            return cold
        loss = self._loss_with_history()
        return torch.where(cold.isnan(), loss, (1.0 - share) * loss + share * cold)

    def _loss_with_history(self) -> Tensor:
        """Returns the loss over the horizon, `(N,)`."""
        batch = self.sampler.validation_with_history()
        divisors = self.shard.errors.over_horizon(batch)
        return self._exact_loss(batch, self.settings.horizon, divisors)

    def _loss_of_cold_starts(self) -> Tensor:
        """Returns the loss of full trajectories, `(N,)`; NaN for networks that keep none."""
        batch = self.sampler.validation_cold_starts()
        if not bool(batch.weight.any()):
            return batch.weight.new_full((len(batch.weight),), torch.nan)
        windows = -(-int(batch.last.max()) // self.exact_step.stride)
        return self._exact_loss(batch, windows, self.shard.errors.over_full_trajectory(batch))

    def _exact_loss(self, batch: RolloutBatch, windows: int, divisors: Divisors) -> Tensor:
        """Returns the weighted mean over trajectories, `(N,)`; NaN where nothing has weight."""
        self._noise_of = 0
        segment = next(self.simulated(self.exact_step, batch, windows))
        loss = torch.where(batch.weight > 0, self.trajectory_loss(segment, divisors), 0.0)
        return loss.mul(batch.weight).sum(1) / batch.weight.sum(1)

    def _rate(self, step: int) -> float:
        """Returns the factor on the learning rate in a gradient step: a warm-up, then a cosine."""
        total = self.settings.epochs * self.settings.steps
        warm_up = min(1.0, (step + 1) / _WARM_UP)
        return warm_up * 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / total)))

    def _compile(self) -> None:
        """Compiles the windows of training and of validation."""
        s = self.settings
        if s.compile != "torch" and self.dataset.base.device.type == "cpu":
            temperature = None
            if s.temperature > 0:
                temperature = self.temperature
            self.compiled = _compiled_loops(self.training_window, temperature, self.exact_step)
        # Sampled paths and experts go window by window.
        goes_by_windows = self.is_stochastic or s.distillation_epochs > 0
        if not self.compiled or goes_by_windows:
            self.training_window.compile()

    def _is_worth_compiling(self) -> bool:
        s = self.settings
        if s.compile == "never" or not can_compile(self.dataset.base.device):
            return False
        return s.compile == "always" or s.epochs * s.steps * s.horizon >= _WORTH_COMPILING


def _compiled_loops(
    training: WindowStep, temperature: Tensor | None, validation: WindowStep
) -> dict[WindowStep, CompiledLoop]:
    """Returns whole trajectories as compiled code, by window; none where there can be none."""
    try:
        from cfx.learners.compiled import compile_windows
    except ModuleNotFoundError as missing:
        if missing.name != "cfx.learners.compiled":
            raise
        log.info("cfx.learners.compiled is not there; PyTorch compiles a window of training")
        return {}
    try:
        return dict(compile_windows(training, temperature, validation))
    except Unsupported as reason:
        log.info("Training has no compiled loop (%s); PyTorch compiles a window", reason)
        return {}


def train(shard: TrainingShard, report: Report) -> TrainedShard:
    """Trains the networks of a shard.

    Training goes on from the shard's checkpoint, and leaves it behind. Where there is no place for
    it, as on a worker without the job's disk, an interrupted training begins again.

    Args:
        shard: which networks, and what they learn from.
        report: called with how many epochs are done, in the end all that were planned.
    """
    if shard.checkpoint is not None and not _has_place(shard.checkpoint):
        expert_shard = shard.expert and replace(shard.expert, checkpoint=None)
        shard = replace(shard, checkpoint=None, expert=expert_shard)
    expert = None
    if shard.expert is not None:
        expert = _trained_expert(shard.expert, report)
    module = RolloutModule(shard, expert, partial(report, 1))
    fit(module, shard.training_data.seed, shard.dataset.pair.device, shard.checkpoint)
    report(shard.settings.epochs - len(module.rows))
    return TrainedShard(module.network.state_dict(), module.curves(), module.fit_dispersion())


def _trained_expert(shard: TrainingShard, report: Report) -> Expert:
    """Trains the experts of a shard, on the same trajectories."""
    module = RolloutModule(shard, None, partial(report, 1))
    fit(module, shard.training_data.seed, shard.dataset.pair.device, shard.checkpoint)
    report(shard.settings.epochs - len(module.rows))
    module.network.requires_grad_(False)
    if module.compiled:
        # Experts say one window at a time what they would do.
        module.training_window.compile()
    return Expert(module.training_window, module.dataset)


def _has_place(checkpoint: Path) -> bool:
    """Says whether the folder of a checkpoint can be written to; makes it."""
    folder = checkpoint.parent
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if os.access(folder, os.W_OK):
        return True
    log.warning("%s cannot be written to: if this training is interrupted, it begins again", folder)
    return False
