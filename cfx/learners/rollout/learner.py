"""Learning through the simulation: the policy is trained on what matters, the closed-loop error of the drives it simulates.

Where window labels are not determined by the data, their average means little (see `imitation`). Here nothing is labelled: from
random measured states on, the policy drives in closed loop behind the measured leader, and the error of its speeds and gaps is
propagated back through the simulation into the network.

Shapes: P pairs of the training data, N networks (each member of an ensemble counts), B drivers of the largest, D drives of one step,
H windows of a drive, W windows of the longest pair, n tuned parameters.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

import lightning.pytorch as pl
import pandas as pd
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.utils.data import DataLoader

from cfx.agents.heads.offset import NONE
from cfx.agents.scaler import Scaler
from cfx.component import Settings, content_key
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult
from cfx.learners.batched import BatchedModule, fit
from cfx.learners.rollout.dataset import (
    BaseErrors,
    Measured,
    RolloutBatch,
    RolloutDataset,
    RolloutInputs,
)
from cfx.learners.rollout.distillation import Expert, apart
from cfx.learners.rollout.step import LoopState, WindowStep, bounded
from cfx.models.direct import Direct
from cfx.parameters import ParameterSpace
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.ensemble import Ensemble
from cfx.progress import Task
from cfx.simulation.rollout import Compile, MemoryStepper, can_compile

log = logging.getLogger(__name__)

_WORTH_COMPILING = 5_000
"""Windows driven in training, one after the other, from which compiling pays: some ten seconds of eager work."""

_VALIDATED = (0.2, 0.4, 0.6, 0.8)
"""Shares of a validation drive at which the policy takes over, having read the part before."""

_LEAST_SPEED, _LEAST_GAP = 0.2, 1.0
"""m/s, m: added to the errors of the base that a drive's error is divided by, so that drives that it fits well do not rule."""

_LEAST_TEMPERATURE = 0.02
"""Below this a smoothed switch has no gradient that single precision resolves."""

_SMALL = 1e-4
"""(m/s)2, m2: keeps the root's slope finite where a drive has no error."""

_WARM_UP = 20
"""Gradient steps over which the learning rate rises."""


class RolloutSettings(Settings):
    """Settings of `rollout`."""

    ensemble_size: int = Field(
        4,
        ge=1,
        description="networks of an ensemble, which answer together; each keeps other drivers for validation",
    )
    epochs: int = Field(
        16, ge=1, description="epochs at most; after each, every network is validated"
    )
    distillation_epochs: int = Field(
        0,
        ge=0,
        description="epochs, the first of them, in which networks learn to do what others would, which set the acceleration"
        " itself (model=direct) and have learned from the same drives for as many epochs as remain; for models with regimes",
    )
    steps: int = Field(25, ge=1, description="gradient steps of an epoch")
    draws: int = Field(
        2, ge=1, description="drives of each driver and step, each from a random measured state"
    )
    drivers: int | None = Field(
        256,
        ge=1,
        description="drivers of a network that drive in one step, and in validation, at most; null: all of them",
    )
    horizon: int = Field(30, ge=1, description="windows that a drive lasts")
    burn_in_s: float | None = Field(
        20.0,
        gt=0,
        description="s of measured history that the policy reads before a drive in training, at most; null: all",
    )
    cold_start_fraction: float = Field(
        0.3,
        ge=0,
        le=1,
        description="share of drives that begin without history, from the population's parameters, where drivers have their own",
    )
    scaling: float = Field(
        0.15,
        ge=0,
        description="augmentation: spread (of the logarithm) of a factor on an unseen driver's distances, speeds and accelerations",
    )
    gap_weight: float = Field(0.1, ge=0, description="weight of the gap's error beside the speed's")
    jerk_weight: float = Field(
        0.0,
        ge=0,
        description="weight of the RMS jerk (m/s3) beside the errors; 0.01 costs little and calms drivers much",
    )
    error: Literal["rmse", "huber"] = Field(
        "rmse",
        description="of a drive: rmse; huber: the root of twice the mean Huber loss, which outliers move less",
    )
    huber_delta: float = Field(
        1.0,
        gt=0,
        description="m/s (speed) and m (gap): where Huber's loss turns from square to linear",
    )
    normalise: bool = Field(
        True,
        description="divide each drive's error by what the base parameters have there, as the improvement is counted",
    )
    learning_rate: float = Field(
        3e-3, gt=0, description="of Adam, at its highest; it falls to 0 along a cosine"
    )
    weight_decay: float = Field(1e-4, ge=0, description="of AdamW, decoupled")
    gradient_clip: float | None = Field(
        1.0, gt=0, description="largest gradient norm of a network; null: none"
    )
    gradient_decay: float = Field(
        0.8,
        gt=0,
        le=1,
        description="factor on gradients that come back through one window; 1 remembers the whole drive",
    )
    gradient_clip_state: float = Field(
        2.0, gt=0, description="largest gradient that one drive's error sends back through a window"
    )
    tbptt_windows: int | None = Field(
        None,
        ge=1,
        description="windows after which gradients are cut and memory is freed; null: the whole drive",
    )
    temperature: float = Field(
        1.0,
        ge=0,
        description="how gradually regimes switch in training, at first; 0: exactly. Evaluation is always exact.",
    )
    temperature_end: float = Field(0.3, ge=0, description="the same in the last epoch")
    validation: float = Field(
        0.25,
        ge=0,
        lt=1,
        description="share of the drivers kept for validation; of each drive's end where drivers are few",
    )
    patience: int | None = Field(
        6,
        ge=1,
        description="epochs without a better validation loss after which a network stops; null: never",
    )
    compile: Compile = Field(
        "auto", description="the window that training repeats: auto: where it pays; always; never"
    )

    @model_validator(mode="after")
    def _drives_at_last(self) -> Self:
        if self.distillation_epochs >= self.epochs:
            raise ValueError(
                f"taught={self.distillation_epochs} leaves none of epochs={self.epochs} to learn by driving; lower learner.distillation_epochs"
            )
        return self


class RolloutLearner(Learner):
    """Back-propagates the error of closed-loop drives into the policy.

    Networks answer offsets (`cfx.agents.heads.offset`): untrained, each driver is driven by his base parameters, so training starts
    from a fixed model. Before a drive the policy reads the driver's measured history up to there; unseen drivers' drives begin with
    none. The drivers of all networks (at most `drivers` of each) drive at once, from random measured states. Models with regimes
    are smoothed meanwhile, and validated as they are; they can be `taught` first, by networks that set the acceleration itself.

    Training goes on where it was interrupted, and gives the same then, if the training data has a workspace.

    Differences from the paper: it imitates window labels.
    """

    schema: ClassVar[type[Settings]] = RolloutSettings
    settings: RolloutSettings
    needs_gradients = True
    uses_driver_features = True
    trial: ClassVar[Mapping[str, Any]] = {
        "ensemble_size": 2,
        "epochs": 4,
        "steps": 12,
        "horizon": 10,
        "learning_rate": 0.02,
    }

    @property
    def reads_history(self) -> bool:
        return self.settings.cold_start_fraction < 1.0

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        """As `Learner.fit`.

        Raises:
            ConfigError: the simulator or the model has no gradients.
        """
        simulator, s = training_data.simulator, self.settings
        self.require_gradients(simulator.model, simulator.differentiable)
        if not {"gap", "time_headway"} & set(policy.inputs):
            log.info(
                "The policy does not see the gap; it drives better with policy.inputs=situation"
            )
        generator = torch.Generator().manual_seed(training_data.seed)
        dataset = RolloutDataset.of(training_data, policy, s.validation, generator, s.ensemble_size)
        network = _untrained(policy, dataset, simulator.model.adaptation_space, generator)
        if not any(parameter.requires_grad for parameter in network.parameters()):
            return _training_result(
                network.eval(), dataset, training_data, pd.DataFrame(columns=CURVE_COLUMNS)
            )
        errors = BaseErrors.of(training_data, dataset, s.horizon) if s.normalise else None
        kept = self.checkpoint(policy, training_data)
        of_expert = kept.with_suffix(".teacher.ckpt") if kept is not None else None
        expert = (
            self._expert(policy, training_data, dataset, errors, of_expert)
            if s.distillation_epochs
            else None
        )
        module = self._trained(
            "Training", network, policy, training_data, dataset, errors, kept, expert
        )
        for file in (kept, of_expert):
            if file is not None:
                file.unlink(missing_ok=True)
        return _training_result(module.network, dataset, training_data, module.curves())

    def _trained(
        self,
        title: str,
        network: PolicyNetwork,
        policy: Policy,
        training_data: TrainingData,
        dataset: RolloutDataset,
        errors: BaseErrors | None,
        kept: Path | None,
        expert: Expert | None = None,
    ) -> RolloutModule:
        """Trains, from the checkpoint `kept` on if it is there, and leaves it behind."""
        s = self.settings
        task = Task(f"{title} ({len(dataset.pair)} networks, at most {s.epochs} epochs)", s.epochs)
        module = RolloutModule(
            network, dataset, policy, training_data, s, errors, expert, on_epoch=task.advance
        )
        device = training_data.batch.lengths.device
        fit(
            module,
            _Steps(s.steps),
            epochs=s.epochs,
            seed=training_data.seed,
            device=device,
            task=task,
            checkpoint=kept,
        )
        return module

    def _expert(
        self,
        policy: Policy,
        training_data: TrainingData,
        dataset: RolloutDataset,
        errors: BaseErrors | None,
        kept: Path | None,
    ) -> Expert:
        """Returns networks that set the acceleration and have learned from the same drives; from `kept` if they had before."""
        s, simulator = self.settings, MemoryStepper(Direct(), training_data.simulator.dt)
        space = simulator.model.adaptation_space
        default = space.defaults(dtype=training_data.fixed.dtype, device=training_data.fixed.device)
        fixed = default.expand(len(training_data.fixed), -1)
        theirs = replace(
            training_data,
            simulator=simulator,
            fixed=fixed,
            base=None if training_data.base is None else fixed,
        )
        steered = dataset.driven_from(space.to_unit(default).float())
        network = _untrained(
            policy, steered, space, torch.Generator().manual_seed(training_data.seed)
        )
        learner = RolloutLearner(
            s.model_copy(
                update={"distillation_epochs": 0, "epochs": s.epochs - s.distillation_epochs}
            )
        )
        module = learner._trained(
            "Training teachers", network, policy, theirs, steered, errors, kept
        )
        module.network.requires_grad_(False)
        return Expert(module.step, steered)

    def checkpoint(self, policy: Policy, training_data: TrainingData) -> Path | None:
        """Returns the file from which this very training goes on, or None without a workspace."""
        if training_data.workspace is None:
            return None
        batch, drives = training_data.batch, hashlib.sha256()
        signals = (
            batch.leader_position,
            batch.leader_speed,
            batch.follower_position,
            batch.follower_speed,
        )
        chosen = (
            training_data.split.frame,
            training_data.fixed,
            training_data.network,
            *([training_data.base] if training_data.base is not None else []),
        )
        for tensor in (*signals, *chosen):
            drives.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        description = {
            "learner": self.identity(),
            "policy": policy.identity(),
            "model": training_data.simulator.model.identity(),
            "windows": training_data.windows.model_dump(),
            "drives": drives.hexdigest(),
            "names": training_data.names,
            "drivers": training_data.drivers,
            "seed": training_data.seed,
        }
        return training_data.workspace / f"{content_key(description)}.ckpt"


def _untrained(
    policy: Policy, dataset: RolloutDataset, space: ParameterSpace, generator: torch.Generator
) -> PolicyNetwork:
    """Returns networks that answer no offset, where the material is."""
    blank = torch.full((len(dataset.pair), len(space)), NONE)
    default = space.to_unit(space.defaults()).float()
    return policy.build(dataset.scaler.mean.shape[-1], default, blank, generator).to(
        dataset.pair.device
    )


def _training_result(
    network: PolicyNetwork,
    dataset: RolloutDataset,
    training_data: TrainingData,
    curves: pd.DataFrame,
) -> TrainingResult:
    """Returns the networks, those of an ensemble as one."""
    space, ensemble_size = training_data.simulator.model.adaptation_space, dataset.ensemble_size
    base = space.from_unit(dataset.start[::ensemble_size].to(training_data.fixed.dtype))
    scaler = Scaler(
        dataset.scaler.mean[::ensemble_size].clone(), dataset.scaler.scale[::ensemble_size].clone()
    )
    return TrainingResult(
        Ensemble(network, ensemble_size).eval() if ensemble_size > 1 else network,
        scaler,
        curves,
        base=base,
    )


class _Steps(pl.LightningDataModule):
    """The numbers of an epoch's gradient steps; what is drawn in each follows from the seed and its number."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def train_dataloader(self) -> DataLoader[Any]:
        return DataLoader(range(self.steps), batch_size=None, shuffle=False)  # type: ignore[arg-type]  # a range is a dataset

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader([0], batch_size=None)  # type: ignore[arg-type]  # a list is a dataset


class Segment(NamedTuple):
    """What was simulated between two truncations, `(N, D, frames)` each.

    Attributes:
        speed, gap: m/s and m.
        measured: at the same frames.
        wanted: the speeds at which a teacher would have driven each window, m/s; None if none is there.
    """

    speed: Tensor
    gap: Tensor
    measured: Measured
    wanted: Tensor | None


class RolloutModule(BatchedModule):
    """Trains N networks on random closed-loop drives.

    Args:
        network, material, policy, training data, settings: what is trained, from what, and how.
        errors: what drives' errors are divided by, if they are; None: those of the training data's own base.
        teacher: who teaches in the first `settings.taught` epochs.
        on_epoch: called after each epoch.
    """

    def __init__(
        self,
        network: PolicyNetwork,
        dataset: RolloutDataset,
        policy: Policy,
        training_data: TrainingData,
        settings: RolloutSettings,
        errors: BaseErrors | None = None,
        expert: Expert | None = None,
        on_epoch: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(
            network, training_data.names, settings, on_epoch, ensemble_size=dataset.ensemble_size
        )
        self.automatic_optimization = False
        self.dataset = dataset
        self.settings = settings
        self.seed = training_data.seed
        self.has_cold_starts = training_data.base is not None
        self.temperature = torch.tensor(settings.temperature, device=dataset.base.device)
        model, dt = training_data.simulator.model, training_data.simulator.dt
        smooth = model.at_temperature(self.temperature) if settings.temperature > 0 else model
        self.exact = WindowStep(network, dataset.scaler, policy, model, training_data.windows, dt)
        self.step = WindowStep(network, dataset.scaler, policy, smooth, training_data.windows, dt)
        if self._compiles():
            self.step.compile()
        self.errors = (
            (errors or BaseErrors.of(training_data, dataset, settings.horizon))
            if settings.normalise
            else None
        )
        self.expert = expert
        drivers = dataset.pair.shape[1]  # for as many drives are drawn, with weight or without
        self.bound = settings.gradient_clip_state / (
            settings.draws * min(drivers, settings.drivers or drivers)
        )
        self.validated = dataset.held(settings.drivers, torch.Generator().manual_seed(self.seed))
        self.losses: list[Tensor] = []

    def _compiles(self) -> bool:
        s = self.settings
        worth_it = s.compile == "always" or (
            s.compile == "auto" and s.epochs * s.steps * s.horizon >= _WORTH_COMPILING
        )
        return worth_it and can_compile(self.dataset.base.device)

    def configure_optimizers(self) -> Any:
        s = self.settings
        optimizer = super().configure_optimizers()
        total = s.epochs * s.steps

        def rate(step: int) -> float:
            return (
                min(1.0, (step + 1) / _WARM_UP)
                * 0.5
                * (1.0 + math.cos(math.pi * min(1.0, step / total)))
            )

        return [optimizer], [torch.optim.lr_scheduler.LambdaLR(optimizer, rate)]

    def on_train_epoch_start(self) -> None:
        s = self.settings
        done = self.current_epoch / max(1, s.epochs - 1)
        self.temperature.fill_(
            max(s.temperature + done * (s.temperature_end - s.temperature), _LEAST_TEMPERATURE)
        )

    def drive(
        self,
        step: WindowStep,
        state: Tensor,
        drives: RolloutBatch,
        windows: int,
        scale: Tensor | None,
    ) -> Iterator[Tensor]:
        """Simulates drives in closed loop.

        Args:
            step: takes one window.
            state: of the policy as each drive begins, as `Material.read` returns it.
            windows: H.
            scale: what the errors of speed and gap are divided by, `(N, D, 2)`; None: nothing.

        Yields:
            The loss of each drive, `(N, D)`, of each stretch between two truncations.
        """
        for speeds, gaps, real, wanted in self.stretches(step, state, drives, windows):
            speed_error = _error(speeds - real.speed, real.counted, self.settings)
            gap_error = _error(gaps - real.gap, real.counted, self.settings)
            if scale is not None:
                speed_error, gap_error = (
                    speed_error / (scale[..., 0] + _LEAST_SPEED),
                    gap_error / (scale[..., 1] + _LEAST_GAP),
                )
            loss = speed_error + self.settings.gap_weight * gap_error
            loss = loss + self.settings.jerk_weight * _rms_jerk(speeds, real.counted, step.dt)
            if wanted is None:
                yield loss
            else:  # what is reported is always the drive's loss; what is learned from is what the teacher would have done
                training_data = _error(speeds - wanted, real.counted, self.settings)
                yield loss.detach() + (training_data - training_data.detach())

    def stretches(
        self, step: WindowStep, state: Tensor, drives: RolloutBatch, windows: int
    ) -> Iterator[Segment]:
        """Simulates drives in closed loop, as `drive` does; yields what came of them between two truncations."""
        s, learning = self.settings, torch.is_grad_enabled()
        pair, base, told = self.dataset.of_drives(drives)
        scene = RolloutInputs.of(self.dataset.batch, pair, drives, step, windows)
        recent = scene.recent(state)
        length = s.tbptt_windows if s.tbptt_windows and learning else windows
        distillation_epochs = (
            self.expert if learning and self.current_epoch < s.distillation_epochs else None
        )
        watching = (
            distillation_epochs.watch(drives, scene.leader_length, self._most())
            if distillation_epochs is not None
            else None
        )
        for first in range(0, windows, length):
            speeds, gaps, wanted = [], [], []
            for window in range(first, min(first + length, windows)):
                if watching is not None:
                    wanted.append(watching.would_drive(recent, scene.ahead(window)))
                recent, speed, gap = step.drive(
                    recent, scene.ahead(window), scene.leader_length, base, told
                )
                if learning:
                    recent = bounded(recent, s.gradient_decay, self.bound)
                if watching is not None:
                    recent = apart(recent)
                speeds.append(speed)
                gaps.append(gap)
            frames = slice(first * step.stride, (first + len(speeds)) * step.stride)
            yield Segment(
                torch.cat(speeds, -1),
                torch.cat(gaps, -1),
                scene.real(frames),
                torch.cat(wanted, -1) if wanted else None,
            )
            recent = LoopState(*(value.detach().requires_grad_(learning) for value in recent))

    def _scale(self, drives: RolloutBatch) -> Tensor | None:
        return self.errors.over_horizon(drives) if self.errors is not None else None

    def training_step(self, number: int, index: int) -> None:
        s, dataset = self.settings, self.dataset
        optimizer, schedule = self.optimizers(), self.lr_schedulers()
        assert isinstance(optimizer, LightningOptimizer)
        assert isinstance(schedule, torch.optim.lr_scheduler.LambdaLR)
        step = self.current_epoch * s.steps + int(number)
        torch.manual_seed(self._seed(step))  # for dropout, which draws from the global generator
        optimizer.zero_grad()
        total = torch.zeros(len(dataset.pair), device=dataset.pair.device)
        for loss in self.losses_of(step):
            self.manual_backward(loss.sum())
            total += loss.detach()
        self.configure_gradient_clipping(optimizer)
        optimizer.step()
        schedule.step()
        self.losses.append(total.cpu())

    def losses_of(self, step: int) -> Iterator[Tensor]:
        """Yields each network's loss in a gradient step, `(N,)`, of each stretch between two truncations."""
        drives = self._draw(step)
        state = self.dataset.read(self.step, drives, self._most())
        count = drives.weight.sum(1).clamp(min=1.0)
        for errors in self.drive(
            self.step, state, drives, self.settings.horizon, self._scale(drives)
        ):
            yield (errors * drives.weight).sum(1) / count

    def _most(self) -> int | None:
        """Returns how many windows of measured history a drive's policy reads at most in training."""
        if self.settings.burn_in_s is None:
            return None
        return max(1, round(self.settings.burn_in_s / (self.step.stride * self.step.dt)))

    def _seed(self, step: int) -> int:
        return (self.seed * 1_000_003 + step) % 2**63

    def _draw(self, step: int) -> RolloutBatch:
        """Draws the drives of one step; they follow from the seed and the step's number, whatever came before."""
        s, dataset = self.settings, self.dataset
        generator = torch.Generator().manual_seed(self._seed(step))
        place = dataset.driving(s.drivers, generator).repeat(1, s.draws)
        shape, device = place.shape, place.device
        share = torch.rand(shape, generator=generator).to(device)
        until = dataset.until.gather(1, place)
        latest = (until // self.step.stride - s.horizon // 2).clamp(min=1)
        cold_start = torch.rand(shape, generator=generator).to(device) < (
            s.cold_start_fraction if self.has_cold_starts else 0.0
        )
        scale = None
        if self.has_cold_starts and s.cold_start_fraction > 0 and s.scaling > 0:
            drawn = torch.exp(s.scaling * torch.randn(shape, generator=generator)).to(device)
            scale = torch.where(cold_start, drawn, 1.0)
        weight = dataset.trains.gather(1, place).float()
        return RolloutBatch(
            place, (share * latest).long(), cold_start, until, weight, scale
        ).weighed()

    @torch.no_grad()
    def validation_step(self, number: int, index: int) -> None:
        train = torch.stack(self.losses).mean(0)
        self.losses.clear()
        self.judge(
            train,
            self._validation_loss().cpu(),
            hopeful=self.current_epoch < self.settings.distillation_epochs,
        )

    def _validation_loss(self) -> Tensor:
        """Returns what the exact model makes of the validation drives, `(N,)`; NaN for a network that has none."""
        s = self.settings
        if self.validated.shape[1] == 0:
            return torch.full((len(self.validated),), torch.nan)
        if not self.has_cold_starts or s.cold_start_fraction == 0:
            return self._validated_with_history()
        whole = self._validated_cold_starts()
        if s.cold_start_fraction == 1 and not bool(whole.isnan().any()):
            return whole
        loss = self._validated_with_history()
        return torch.where(
            whole.isnan(),
            loss,
            (1.0 - s.cold_start_fraction) * loss + s.cold_start_fraction * whole,
        )

    def _validated_with_history(self) -> Tensor:
        """Returns the loss of drives over the horizon, of which the part before was read."""
        dataset, place = self.dataset, self.validated
        last, until = dataset.last.gather(1, place), dataset.until.gather(1, place)
        began = torch.where(until < last, until, 0)
        starts = [
            ((began + share * (last - began)) / self.exact.stride).long() for share in _VALIDATED
        ]
        places, lasts, weight = (x.repeat(1, len(starts)) for x in (place, last, self._weight()))
        drives = RolloutBatch(
            places, torch.cat(starts, 1), torch.zeros_like(places, dtype=torch.bool), lasts, weight
        )
        state = dataset.read(self.exact, drives)
        return _mean(
            next(self.drive(self.exact, state, drives, self.settings.horizon, self._scale(drives))),
            weight,
        )

    def _validated_cold_starts(self) -> Tensor:
        """Returns the loss of whole drives, of which nothing was read; NaN where drivers are few and none is kept whole."""
        dataset, place = self.dataset, self.validated
        last = dataset.last.gather(1, place)
        weight = self._weight() * (dataset.until.gather(1, place) == last)
        drives = RolloutBatch(
            place, torch.zeros_like(place), torch.ones_like(place, dtype=torch.bool), last, weight
        )
        if not bool(weight.any()):
            return weight.new_full((len(weight),), torch.nan)
        windows = -(-int(last.max()) // self.exact.stride)
        scale = self.errors.over_whole(drives) if self.errors is not None else None
        return _mean(
            next(self.drive(self.exact, dataset.read(self.exact, drives), drives, windows, scale)),
            weight,
        )

    def _weight(self) -> Tensor:
        return self.dataset.validates.gather(1, self.validated).float()


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """Returns the weighted mean over drives, `(N,)`; NaN where nothing has weight."""
    return torch.where(weight > 0, values, 0.0).mul(weight).sum(1) / weight.sum(1)


def _error(difference: Tensor, counted: Tensor, settings: RolloutSettings) -> Tensor:
    """Returns the error of each drive, `(N, D)`, over the frames that count."""
    if settings.error == "huber":
        nothing = torch.zeros_like(difference)
        squares = 2.0 * nn.functional.huber_loss(
            difference, nothing, reduction="none", delta=settings.huber_delta
        )
    else:
        squares = difference.square()
    return ((squares * counted).sum(-1) / counted.sum(-1).clamp(min=1.0) + _SMALL).sqrt()


def _rms_jerk(speeds: Tensor, counted: Tensor, dt: float) -> Tensor:
    """Returns the RMS jerk of each drive, m/s3, `(N, D)`, over the frames that count."""
    jerk = speeds.diff(n=2, dim=-1) / (dt * dt)
    weight = counted[..., 2:]
    return ((jerk.square() * weight).sum(-1) / weight.sum(-1).clamp(min=1.0) + _SMALL).sqrt()
