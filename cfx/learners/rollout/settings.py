"""Settings of the learner `rollout`, in groups; in a configuration their keys stand side by side.

A driver's trajectory is one simulated drive of a gradient step; a window is the time for which one
set of parameters holds (`windows.stride`).
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from cfx.core.component import Settings
from cfx.policies.heads import trained_head


class OptimisationSettings(Settings):
    """Networks with their head, optimisation and validation."""

    head: Annotated[str, AfterValidator(trained_head("rollout"))] = Field(
        "offset",
        description="offset: offsets from each driver's base parameters; residual: also how the"
        " model takes over from the acceleration at the start, so that the policy starts with"
        " exactly the acceleration that the driver has; stochastic: also how much"
        " the acceleration and the parameters vary, trained by the CRPS of sampled paths and the"
        " error of the path without noise",
    )
    paths: int = Field(
        2,
        ge=2,
        le=64,
        description="sampled paths of each trajectory in training, for head=stochastic",
    )
    ensemble_size: int = Field(
        4,
        ge=1,
        le=64,
        description="networks of an ensemble, which answer together; each keeps other drivers for"
        " validation",
    )
    start: str | None = Field(
        None,
        description="the folder of a finished job, or cfx://NAME: networks begin as its network for"
        " unseen drivers, or as the one named behind it (FOLDER#NETWORK), and learn on from there;"
        " null: untrained",
    )
    epochs: int = Field(
        16, ge=1, description="epochs at most; after each, every network is validated"
    )
    steps: int = Field(25, ge=1, description="gradient steps of an epoch")
    learning_rate: float = Field(
        3e-3, gt=0, le=1, description="of Adam, at its highest; it falls to 0 along a cosine"
    )
    weight_decay: float = Field(1e-4, ge=0, le=10, description="of AdamW, decoupled")
    gradient_clip: float | None = Field(
        1.0, gt=0, description="largest gradient norm of a network; null: none"
    )
    validation: float = Field(
        0.25,
        ge=0,
        lt=1,
        description="share of the drivers kept for validation; of each trajectory's end where"
        " drivers are few",
    )
    patience: int | None = Field(
        6,
        ge=1,
        description="epochs without a better validation loss after which a network stops; null:"
        " never",
    )


class TrajectorySettings(Settings):
    """Sampling of trajectories, and cold starts, as of unseen drivers."""

    draws: int = Field(
        2,
        ge=1,
        description="trajectories of each driver and step, each from a random measured state",
    )
    drivers: int | None = Field(
        256,
        ge=1,
        description="drivers of a network in one step, and in validation, at most; null: all",
    )
    balance: float = Field(
        0.0,
        ge=0,
        le=1,
        description="how evenly sites are sampled, in each site drivers, and of each driver frames:"
        " 0: every pair is as likely; 1: every site, in it every driver, and of them every frame;"
        " 0.5: by the square roots of how many pairs and frames there are",
    )
    horizon: int = Field(30, ge=1, description="windows that a trajectory lasts")
    burn_in_s: float | None = Field(
        20.0,
        gt=0,
        description="s of measured history that the policy observes before a trajectory in"
        " training, at most; null: all",
    )
    cold_start_fraction: float = Field(
        0.3,
        ge=0,
        le=1,
        description="share of trajectories without history, from the pooled parameters, where"
        " drivers have parameters of their own",
    )
    scaling: float = Field(
        0.15,
        ge=0,
        le=1,
        description="augmentation: standard deviation of the logarithm of a factor on distances,"
        " speeds and accelerations of a cold start",
    )
    speed_shift: float = Field(
        20.0,
        ge=0,
        le=40,
        description="augmentation: m/s, at most added to the speeds of both vehicles in a part of"
        " the cold starts, which makes motorways of congestion: accelerations stay, and the gap"
        " grows by the driver's own time gap; 0: none",
    )
    simulated_drivers: int = Field(
        0,
        ge=0,
        le=100_000,
        description="drivers of Krauss's model and of IDM in stop-and-go traffic of 2 to 6 m/s,"
        " from whom networks learn too, for roads that are slower than those that were recorded;"
        " 0: none",
    )
    simulated_queues: int = Field(
        0,
        ge=0,
        le=100_000,
        description="drivers of IDM who leave queues at lights, from whom networks learn too, for"
        " streets with lights, of which there is hardly an open recording; 0: none",
    )


class LossSettings(Settings):
    """Terms beside the job's objective, gradients through time, and switches of regimes."""

    gap_weight: float = Field(
        0.1, ge=0, description="weight of the gap's RMSE beside the job's objective"
    )
    time_weighting: Literal["even", "relative"] = Field(
        "even",
        description="how times after a trajectory's start count: even: errors alike; relative:"
        " errors relative to what an untrained policy has at that time, so that the first second"
        " counts too",
    )
    jerk_weight: float = Field(
        0.0,
        ge=0,
        description="weight of the RMS jerk (m/s3) beside the errors; 0.01 costs little accuracy"
        " and makes the trajectories much smoother",
    )
    equilibrium_weight: float = Field(
        0.0,
        ge=0,
        description="weight of the RMS relative error of the spacing at which drivers settle behind"
        " leaders of constant speed, from any start, against the recorded relation of gap and speed"
        " of the drivers that are learned from; 0: none",
    )
    equilibrium_s: float = Field(
        60.0,
        ge=5,
        le=600,
        description="s that these trajectories last; the second half counts",
    )
    gradient_decay: float = Field(
        0.8,
        gt=0,
        le=1,
        description="factor on gradients that come back through one window; 1: none is forgotten",
    )
    gradient_clip_state: float = Field(
        2.0,
        gt=0,
        description="largest gradient that one trajectory's error sends back through a window",
    )
    tbptt_windows: int | None = Field(
        None,
        ge=1,
        description="windows after which gradients are cut and memory is freed; null: the whole"
        " trajectory",
    )
    temperature: float = Field(
        1.0,
        ge=0,
        description="how gradually regimes switch in training, at first; 0: exactly. Evaluation is"
        " always exact.",
    )
    temperature_end: float = Field(0.3, ge=0, description="the same in the last epoch")


# All settings of `rollout`: pydantic lists the fields of the last base first.
class RolloutSettings(LossSettings, TrajectorySettings, OptimisationSettings):
    """Distillation and computation."""

    distillation_epochs: int = Field(
        0,
        ge=0,
        description="the first epochs, in which networks imitate experts: networks that set the"
        " acceleration (model=direct), trained before for the remaining number of epochs; for"
        " models with regimes",
    )
    compile: Literal["auto", "always", "never", "torch"] = Field(
        "auto",
        description="the window that training repeats: auto: where it pays, networks with memory by"
        " cfx's own compiled code; always; never; torch: where it pays, by torch.compile alone",
    )

    @model_validator(mode="after")
    def _some_epochs_in_closed_loop(self) -> Self:
        if self.distillation_epochs >= self.epochs:
            raise ValueError(
                f"distillation_epochs={self.distillation_epochs} leaves none of"
                f" epochs={self.epochs} for training in closed loop; lower"
                " learner.distillation_epochs"
            )
        return self
