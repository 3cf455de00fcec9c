"""The contract of a posterior: what recordings say of drivers' parameters.

Shapes: P drivers, n tuned parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, cast

from cfx.core import registry
from cfx.errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray
    from torch import Tensor
    from xarray import DataTree

    from cfx.calibration.settings import CalibrationSettings
    from cfx.calibration.shards import Solver
    from cfx.data.pairs import PairBatch
    from cfx.models.base import DrivingModel


class DriverPosteriors(ABC):
    """What P recordings say of parameters."""

    draws: Tensor
    """Equally likely parameters, `(P, draws, n)`, SI units: as correlated as a recording leaves
    them."""

    @abstractmethod
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Returns columns for a row per driver of the table `fits`, `(P,)` each.

        `median_NAME`, `low_NAME`, `high_NAME`, `contraction_NAME`, `noise_scale`,
        `noise_correlation`, `noise_left`, `effective_samples`, and `pareto_k` (with
        `expected_coverage`, if a network has learned) or `r_hat` (and `divergences`); where
        forecasts were compared with held-out parts, `held` and `held_chance`; where there are
        several kinds of noise, `noise` and `noise_gain`; `likelihood_power`, where the model
        declares one. The table says what they mean.
        """

    @abstractmethod
    def tables(self, ids: Sequence[str]) -> dict[str, pd.DataFrame]:
        """Returns further tables by name.

        Args:
            ids: of the pairs.
        """

    def inference_data(self, ids: Sequence[str], model: DrivingModel) -> DataTree:
        """Returns the draws as ArviZ reads them.

        Args:
            ids: of the pairs.
            model: whose parameters they are.

        Raises:
            ConfigError: this posterior has no such form; the base class raises it.
        """
        raise ConfigError(
            f"{type(self).__name__} does not give its draws as ArviZ reads them; take"
            " calibration.posterior=laplace, nuts, sbi or hierarchical"
        )

    @abstractmethod
    def draw_drivers(self, count: int, seed: int) -> Tensor:
        """Returns parameters of drivers who were not recorded, `(count, n)`, SI units."""


class PosteriorMethod(ABC):
    """Base of every way to find posteriors.

    An entry point of the group `cfx.posteriors` makes it known: `calibration.posterior=NAME`.

    Attributes:
        has_population: whether it finds the population that all drivers come from.
        any_simulator: whether it asks for few enough simulations for simulators that are slower
            than `simulator=memory`.
    """

    has_population: ClassVar[bool] = False
    any_simulator: ClassVar[bool] = False

    @abstractmethod
    def find(
        self,
        solver: Solver,
        batch: PairBatch,
        last: Tensor,
        best: Tensor,
        settings: CalibrationSettings,
    ) -> DriverPosteriors:
        """Returns what each driver's recording says of their parameters.

        Args:
            solver: whose model, time step and objective count, and which bounds the memory.
            batch: P pairs.
            last: `(P,)`, the last frame that is compared; simulated from frame 0 in one closed
                loop.
            best: `(P, n)`, the point estimates, SI units.
            settings: prior and noise.
        """


def posterior_method(name: str) -> PosteriorMethod:
    """Returns the way to find posteriors of a name.

    Raises:
        PluginError: it is not installed, or cannot be imported.
    """
    return cast("type[PosteriorMethod]", registry.get("posterior", name))()
