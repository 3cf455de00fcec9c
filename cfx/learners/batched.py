"""Training of N networks as one batched network, each as if alone; all learners use it.

The sum of N losses trains every network by its own loss. Gradients are clipped, the best epoch is
chosen and training stops for each network on its own.

Shapes: N networks.
"""

from __future__ import annotations

import contextlib
import logging
import math
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol

import lightning.pytorch as pl
import pandas as pd
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from torch import Tensor, nn
from torch.utils.data import DataLoader

from cfx.core.files import atomic_write
from cfx.core.guest import no_autologging
from cfx.core.threads import one_thread
from cfx.learners.base import CURVE_COLUMNS
from cfx.policies.base import PolicyNetwork

log = logging.getLogger(__name__)


class Training(Protocol):
    """Settings that every such learner has."""

    @property
    def epochs(self) -> int: ...
    @property
    def learning_rate(self) -> float: ...
    @property
    def weight_decay(self) -> float: ...
    @property
    def gradient_clip(self) -> float | None: ...
    @property
    def patience(self) -> int | None: ...


_KEPT = ("best", "best_loss", "stale", "rows")
"""What a checkpoint holds of a module beside what Lightning does."""


class BatchedModule(pl.LightningModule):
    """Trains N networks and keeps the weights of each one's best epoch.

    A subclass says what a batch and a step are (`train_dataloader`, `training_step`), and ends an
    epoch by `judge` in `validation_step`.

    Args:
        network: the networks; `ensemble_size` of them, behind one another, share a name.
        names: of the networks, or of their ensembles.
        settings: of the learner.
        on_epoch: called after each epoch.
        ensemble_size: networks of an ensemble.

    Attributes:
        fused: the optimiser updates all weights in one pass; where steps are tiny, most of a step
            is the optimiser otherwise.
    """

    fused: ClassVar[bool] = False

    def __init__(
        self,
        network: PolicyNetwork,
        names: tuple[str, ...],
        settings: Training,
        on_epoch: Callable[[], None] = lambda: None,
        *,
        ensemble_size: int = 1,
    ) -> None:
        super().__init__()
        networks = len(names) * ensemble_size
        self.network = network
        self.names = names
        self.ensemble_size = ensemble_size
        self.settings = settings
        self.automatic_optimization = False
        self.on_epoch = on_epoch
        self.best: dict[str, Tensor] = {}
        for key, value in network.named_parameters():
            self.best[key] = value.detach().clone()
        self.best_loss = torch.full((networks,), math.inf)
        self.stale = torch.zeros(networks, dtype=torch.int64)
        self.rows: list[tuple[Tensor, Tensor]] = []

    def begin_random_numbers(self, seed: int, device: torch.device) -> None:
        """Makes the generators that training draws from; PyTorch's global one is the caller's.

        Attributes that it sets:
            generator: for dropout, on the device of the networks.
            loaders_generator: for loaders of data, which draw a number for each epoch.
        """
        self.generator = torch.Generator(device).manual_seed(seed)
        self.loaders_generator = self.generator
        if device.type != "cpu":
            self.loaders_generator = torch.Generator().manual_seed(seed)

    def val_dataloader(self) -> DataLoader[Any]:
        """Returns one batch, so that an epoch is validated once."""
        once: Any = [0]
        return DataLoader(once, batch_size=None, generator=self.loaders_generator)

    def configure_optimizers(self) -> Any:
        s = self.settings
        parameters = self.network.parameters()
        return torch.optim.AdamW(
            parameters, lr=s.learning_rate, weight_decay=s.weight_decay, fused=self.fused
        )

    def configure_gradient_clipping(self, optimizer: Any, *args: Any, **kwargs: Any) -> None:
        """Clips each network's gradient on its own: a norm over all would couple them."""
        if self.settings.gradient_clip is not None:
            clip_each(self.network, self.settings.gradient_clip)

    def judge(self, train: Tensor, validation: Tensor, *, hopeful: bool = False) -> None:
        """Ends an epoch.

        Keeps the weights of each network whose loss is the best so far, and stops the training when
        every network has gone without a better one for `patience` epochs.

        Args:
            train: training losses, `(N,)` on the CPU.
            validation: validation losses, `(N,)` on the CPU; where NaN, the training loss counts.
            hopeful: this epoch does not count towards the patience.
        """
        self.rows.append((train, validation))
        loss = torch.where(validation.isnan(), train, validation)
        patience = self.settings.patience
        active = torch.ones_like(self.stale, dtype=torch.bool)
        if patience is not None:
            active = self.stale < patience
        better = (loss < self.best_loss) & active
        self.best_loss = torch.where(better, loss, self.best_loss)
        self.stale = torch.where(better, 0, self.stale + (active & (not hopeful)).long())
        for key, value in self.network.named_parameters():
            chosen = better.to(value.device).view(-1, *[1] * (value.dim() - 1))
            self.best[key] = torch.where(chosen, value.detach(), self.best[key].to(value.device))
        self._stop_where_none_improves()
        self.on_epoch()

    def _stop_where_none_improves(self) -> None:
        patience = self.settings.patience
        if patience is not None and not bool((self.stale < patience).any()):
            self.trainer.should_stop = True

    def forget_best(self) -> None:
        """Forgets the best epoch so far: later losses are of something else, and do not compare."""
        self.best_loss = torch.full_like(self.best_loss, torch.inf)

    def restore_best(self) -> None:
        """Puts each network's best weights back."""
        with torch.no_grad():
            for key, value in self.network.named_parameters():
                value.copy_(self.best[key])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["batched"] = {name: getattr(self, name) for name in _KEPT}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        for name in _KEPT:
            setattr(self, name, checkpoint["batched"][name])
        self._stop_where_none_improves()
        for _ in self.rows:
            self.on_epoch()

    def curves(self) -> pd.DataFrame:
        """Returns the learning curves in long form; networks that share a name are averaged."""
        frames = []
        for epoch, (train, validation) in enumerate(self.rows):
            columns = {
                "network": self.names,
                "epoch": epoch,
                "train_loss": self._mean(train),
                "validation_loss": self._mean(validation),
            }
            frames.append(pd.DataFrame(columns))
        if not frames:
            return pd.DataFrame(columns=CURVE_COLUMNS)
        return pd.concat(frames, ignore_index=True)

    def _mean(self, losses: Tensor) -> list[float]:
        return losses.view(-1, self.ensemble_size).mean(1).tolist()


def clip_each(network: PolicyNetwork, largest: float) -> None:
    """Scales each network's gradient to a norm of at most `largest`; where not finite, to 0."""
    gradients, squares = [], []
    for parameter in network.parameters():
        if parameter.grad is not None:
            gradients.append(parameter.grad)
            squares.append(parameter.grad.square().flatten(1).sum(1))
    norm = torch.stack(squares).sum(0).sqrt()
    scale = torch.where(norm.isfinite(), (largest / norm.clamp(min=1e-12)).clamp(max=1.0), 0.0)
    for gradient in gradients:
        of_network = scale.view(-1, *[1] * (gradient.dim() - 1))
        gradient.nan_to_num_(0.0, 0.0, 0.0).mul_(of_network)


def fit(module: BatchedModule, seed: int, device: torch.device, checkpoint: Path | None) -> None:
    """Trains with Lightning, quietly, and puts the best weights back.

    Args:
        module: what is trained.
        seed: of what dropout draws.
        device: where.
        checkpoint: written after every epoch, so that interrupted training goes on there, and
            training that ended gives the same at once. None: no such file.
    """
    accelerator = "gpu" if device.type == "cuda" else "cpu"
    callbacks: list[pl.Callback] = []
    if checkpoint is not None:
        callbacks.append(EveryEpoch(checkpoint))
    module.begin_random_numbers(seed, device)
    with (
        dropout_from(module.network, module.generator),
        no_autologging(),
        warnings.catch_warnings(),
        one_thread(),
        _quiet_lightning(),
    ):
        warnings.filterwarnings("ignore", module=r"lightning\.")
        # torch's compiler looks at everything that it is given.
        of_compiler = r"The \.grad attribute of a Tensor that is not a leaf"
        warnings.filterwarnings("ignore", message=of_compiler)
        trainer = pl.Trainer(
            max_epochs=module.settings.epochs,
            accelerator=accelerator,
            devices=1,
            logger=False,
            callbacks=callbacks,
            # Jobs in a queue of Slurm are no parts of one training on many machines.
            plugins=[LightningEnvironment()],
            enable_checkpointing=False,
            enable_model_summary=False,
            enable_progress_bar=False,
            num_sanity_val_steps=0,
            # Nothing random happens between batches, and they must come in order.
            use_distributed_sampler=False,
        )
        start = None
        if checkpoint is not None and checkpoint.is_file():
            start = checkpoint
            log.info("Training goes on from %s", checkpoint)
        try:
            trainer.fit(module, ckpt_path=start, weights_only=True)
        except SystemExit as error:
            # Lightning turns Ctrl-C into an exit.
            if isinstance(error.__context__, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            raise
    module.restore_best()
    module.network.to(device).eval()


@contextlib.contextmanager
def dropout_from(network: nn.Module, generator: torch.Generator) -> Iterator[None]:
    """Lets the dropout layers of a network draw from a generator in the block.

    PyTorch's own draw from the global generator, which another thread of the program may draw from
    at the same time.
    """
    layers = []
    for layer in network.modules():
        if type(layer) is nn.Dropout and layer.p > 0:
            layers.append(layer)
            # A compiled step would draw numbers of its compiler's.
            drawing = torch.compiler.disable(partial(_dropped, layer, generator))  # type: ignore[no-untyped-call]
            layer.forward = drawing  # type: ignore[method-assign]
    try:
        yield
    finally:
        for layer in layers:
            del layer.forward


def _dropped(layer: nn.Dropout, generator: torch.Generator, values: Tensor) -> Tensor:
    """Returns what `torch.nn.functional.dropout` does for the same numbers, bit by bit."""
    if not layer.training:
        return values
    mask = torch.empty_like(values).bernoulli_(1.0 - layer.p, generator=generator)
    if layer.p < 1:
        mask.div_(1.0 - layer.p)
    return values * mask


@contextlib.contextmanager
def _quiet_lightning() -> Iterator[None]:
    """Keeps Lightning's messages about devices and epochs off the terminal."""
    loggers = [logging.getLogger(f"lightning.{name}") for name in ("pytorch", "fabric")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class EveryEpoch(pl.Callback):
    """Writes one checkpoint atomically after every epoch."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.path) as temporary:
            trainer.save_checkpoint(temporary)
