"""What learners of many networks share: N networks train as one batched network, and each as if it were alone.

The sum of N losses trains every network by its own loss; gradients are clipped, the best epoch is chosen and training stops for
each on its own.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import lightning.pytorch as pl
import pandas as pd
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor

from cfx.agents.placement import driver_places
from cfx.files import atomic_write
from cfx.learners.base import CURVE_COLUMNS
from cfx.policies.base import PolicyNetwork
from cfx.progress import Task
from cfx.simulation.threads import one_thread

log = logging.getLogger(__name__)


class Grid:
    """Places P pairs as N networks by B drivers."""

    def __init__(self, network: Tensor, networks: int) -> None:
        """Takes which network learns from each pair, `(P,)`."""
        self.network = network
        self.place = driver_places(network)
        self.shape = (networks, int(self.place.max()) + 1)

    def scatter(self, values: Tensor) -> Tensor:
        """Arranges `(P, ...)` as `(N, B, ...)`, zero where a network has fewer drivers."""
        grid = values.new_zeros((*self.shape, *values.shape[1:]))
        grid[self.network, self.place] = values
        return grid

    def mean(self, values: Tensor) -> Tensor:
        """Returns the mean of `(P, n)` over each network's pairs, `(N, n)`."""
        total = values.new_zeros((self.shape[0], values.shape[1])).index_add_(
            0, self.network, values
        )
        return total / torch.bincount(self.network, minlength=self.shape[0])[:, None]


class Training(Protocol):
    """Settings that every such learner has."""

    @property
    def learning_rate(self) -> float: ...
    @property
    def weight_decay(self) -> float: ...
    @property
    def gradient_clip(self) -> float | None: ...
    @property
    def patience(self) -> int | None: ...


class BatchedModule(pl.LightningModule):
    """Trains N networks and keeps the weights of each one's best epoch; `members` of them, behind one another, share a name."""

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
        self.network = network
        self.names = names
        self.ensemble_size = ensemble_size
        self.training_settings = settings
        self.on_epoch = on_epoch
        self.best = {key: value.detach().clone() for key, value in network.named_parameters()}
        self.best_loss = torch.full((len(names) * ensemble_size,), math.inf)
        self.stale = torch.zeros(len(names) * ensemble_size, dtype=torch.int64)
        self.rows: list[tuple[Tensor, Tensor]] = []

    def configure_optimizers(self) -> Any:
        s = self.training_settings
        return torch.optim.AdamW(
            self.network.parameters(), lr=s.learning_rate, weight_decay=s.weight_decay
        )

    def configure_gradient_clipping(self, optimizer: Any, *args: Any, **kwargs: Any) -> None:
        """Clips each network's gradient on its own: a norm over all would couple them."""
        if self.training_settings.gradient_clip is not None:
            clip_each(self.network, self.training_settings.gradient_clip)

    def judge(self, train: Tensor, validation: Tensor, *, hopeful: bool = False) -> None:
        """Ends an epoch: keeps the weights of each network's best one, and stops when no network has hope left.

        Args:
            train, validation: losses `(N,)` on the CPU; a network whose validation loss is NaN is judged by its training loss.
            hopeful: no network loses patience in this epoch.
        """
        self.rows.append((train, validation))
        loss = torch.where(validation.isnan(), train, validation)
        patience = self.training_settings.patience
        active = (
            torch.ones_like(self.stale, dtype=torch.bool)
            if patience is None
            else self.stale < patience
        )
        better = (loss < self.best_loss) & active
        self.best_loss = torch.where(better, loss, self.best_loss)
        self.stale = torch.where(better, 0, self.stale + (active & (not hopeful)).long())
        for key, value in self.network.named_parameters():
            chosen = better.to(value.device).view(-1, *[1] * (value.dim() - 1))
            self.best[key] = torch.where(chosen, value.detach(), self.best[key].to(value.device))
        if patience is not None and not bool((self.stale < patience).any()):
            self.trainer.should_stop = True
        self.on_epoch()

    def restore_best(self) -> None:
        """Puts each network's best weights back."""
        with torch.no_grad():
            for key, value in self.network.named_parameters():
                value.copy_(self.best[key])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        kept = {
            "best": self.best,
            "best_loss": self.best_loss,
            "stale": self.stale,
            "rows": self.rows,
        }
        checkpoint["batched"] = kept

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        kept = checkpoint["batched"]
        self.best, self.best_loss, self.stale = dict(kept["best"]), kept["best_loss"], kept["stale"]
        self.rows = [(train, validation) for train, validation in kept["rows"]]
        for _ in self.rows:
            self.on_epoch()

    def curves(self) -> pd.DataFrame:
        """Returns the learning curves in long form; those who share a name, on average."""
        frames = [
            pd.DataFrame(
                {
                    "network": self.names,
                    "epoch": epoch,
                    "train_loss": self._mean(train),
                    "validation_loss": self._mean(validation),
                }
            )
            for epoch, (train, validation) in enumerate(self.rows)
        ]
        return (
            pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=CURVE_COLUMNS)
        )

    def _mean(self, losses: Tensor) -> list[float]:
        return losses.view(-1, self.ensemble_size).mean(1).tolist()


def clip_each(network: PolicyNetwork, largest: float) -> None:
    """Scales each network's gradient to a norm of at most `largest`; a gradient that is not finite becomes 0."""
    gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
    norm = (
        torch.stack([gradient.square().flatten(1).sum(1) for gradient in gradients]).sum(0).sqrt()
    )
    scale = torch.where(norm.isfinite(), (largest / norm.clamp(min=1e-12)).clamp(max=1.0), 0.0)
    for gradient in gradients:
        gradient.nan_to_num_(0.0, 0.0, 0.0).mul_(scale.view(-1, *[1] * (gradient.dim() - 1)))


def fit(
    module: BatchedModule,
    data: pl.LightningDataModule,
    *,
    epochs: int,
    seed: int,
    device: torch.device,
    task: Task,
    checkpoint: Path | None = None,
) -> None:
    """Trains with Lightning, quietly, and puts the best weights back.

    Args:
        checkpoint: written after every epoch, so that interrupted training goes on there, and one that ended gives the same at
            once. None: no such file.
    """
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(seed)  # dropout draws from the global generator
        trainer = pl.Trainer(
            max_epochs=epochs,
            accelerator="gpu" if device.type == "cuda" else "cpu",
            devices=1,
            logger=False,
            callbacks=[EveryEpoch(checkpoint)] if checkpoint is not None else [],
            enable_checkpointing=checkpoint is not None,
            enable_model_summary=False,
            enable_progress_bar=False,
            num_sanity_val_steps=0,
            # Nothing random happens between batches, and they must come in order.
            use_distributed_sampler=False,
        )
        with warnings.catch_warnings(), one_thread(), task:
            warnings.filterwarnings("ignore", module=r"lightning\.")
            # torch's compiler looks at everything that it is given.
            warnings.filterwarnings(
                "ignore", message=r"The \.grad attribute of a Tensor that is not a leaf"
            )
            _run(trainer, module, data, checkpoint)
    module.restore_best()
    module.network.to(device).eval()


class EveryEpoch(ModelCheckpoint):
    """Writes one checkpoint, whole, after every epoch."""

    def __init__(self, path: Path) -> None:
        super().__init__(save_top_k=0)
        self.path = path

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Waits for the end of the epoch."""

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.path) as temporary:
            trainer.save_checkpoint(temporary)


def _run(
    trainer: pl.Trainer,
    module: BatchedModule,
    data: pl.LightningDataModule,
    checkpoint: Path | None,
) -> None:
    """Fits, from the checkpoint if there is one; Ctrl-C, which Lightning turns into an exit, stays what it is."""
    started = checkpoint is not None and checkpoint.is_file()
    if started:
        log.info("Training goes on from %s", checkpoint)
    try:
        trainer.fit(
            module, datamodule=data, ckpt_path=checkpoint if started else None, weights_only=True
        )
    except SystemExit as error:
        if isinstance(error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise
