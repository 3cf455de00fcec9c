"""Calibration as a scikit-learn estimator, for its cross-validation and its searches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils import Tags
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from cfx import simulate
from cfx.api.experiment import config
from cfx.api.pairs import Pairs, read
from cfx.app.job import steps
from cfx.calibration.identifiability import losses_of
from cfx.core.guest import visit
from cfx.data.frames import Frame, frame_of_any
from cfx.data.tidy import row_order
from cfx.evaluation.protocols.base import ProtocolContext
from cfx.simulation.windows import Split


class CarFollowingRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc] # no types
    """Pooled calibration of a driving model: fitted on some drivers, it predicts others' speeds.

    A sample is one frame of one pair: a row of a table in the tidy layout, in a data frame of any
    library that `cfx.read` takes. All rows of a pair form one trajectory, so they must stay in one
    fold: split by `groups`, as `GroupKFold` does.

    The checks of scikit-learn's `check_estimator` that concern parameters, cloning, tags and
    representation pass. Its other checks fit arrays of random numbers, which hold no pair and no
    time and so no trajectory; the tag `two_d_array=False` excludes them.

    Args:
        model: as after `model=`.
        objective: what is minimised, as after `objective=`.
        seed: the same seed gives the same parameters.
        settings: others of the command line, by key: `{"optimizer": "random"}`.

    Attributes:
        parameters_: the pooled parameters, SI units.
        feature_names_in_: columns of the table.
        n_features_in_: how many there are.

    Examples:
        >>> import cfx
        >>> from cfx.sklearn import CarFollowingRegressor
        >>> from sklearn.model_selection import GridSearchCV, GroupKFold
        >>> table = cfx.read(dataset="synthetic", pairs=4, frames=120).frame
        >>> settings = {"optimizer": "random", "optimizer.samples": 64, "calibration.prior": "weak"}
        >>> regressor = CarFollowingRegressor(settings=settings)
        >>> search = GridSearchCV(regressor, {"model": ["idm", "krauss"]}, cv=GroupKFold(2))
        >>> search.fit(table, groups=table["pair_id"]).best_params_["model"] in {"idm", "krauss"}
        True
        >>> search.predict(table).shape
        (480,)
    """

    def __init__(
        self,
        model: str = "idm",
        objective: str = "speed_rmse",
        seed: int = 0,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self.model = model
        self.objective = objective
        self.seed = seed
        self.settings = settings

    def fit(self, X: Any, y: object = None, groups: ArrayLike | None = None) -> Self:  # noqa: N803 - scikit-learn's name
        """Calibrates one set of parameters on the whole trajectories.

        Args:
            X: a table in the tidy layout.
            y: is not read: speeds are in the table.
            groups: is not read: pairs are in the table.

        Raises:
            CfxError: the table is not in the layout, or a parameter is wrong.
        """
        table = frame_of_any(X, "X")
        self.parameters_ = self._pooled(_pairs(table))
        self.feature_names_in_ = np.asarray(table.names, dtype=object)
        self.n_features_in_ = len(table.names)
        return self

    def predict(self, X: Any) -> NDArray[np.float64]:  # noqa: N803 - as above
        """Simulates each follower from the first row of their pair on, in closed loop.

        Args:
            X: a table in the tidy layout.

        Returns:
            The followers' speeds in the order of the rows, m/s.
        """
        check_is_fitted(self)
        table = frame_of_any(X, "X")
        # A prediction calibrates nothing, so settings such as the optimizer's have no place here.
        settings = dict(self.settings or {})
        for key in self.settings or {}:
            if not key.startswith(("model.", "data.")):
                del settings[key]
        trajectories = simulate(self.model, self.parameters_, _pairs(table), **settings)
        order = row_order(table)
        speed = np.empty(len(order))
        speed[order] = trajectories["speed"]
        return speed

    def score(self, X: Any, y: object = None) -> float:  # noqa: N803 - as above
        """Returns minus the mean loss over the pairs, in the objective's unit: greater is better.

        Args:
            X: a table in the tidy layout.
            y: is not read.
        """
        check_is_fitted(self)
        context, last = self._prepared(_pairs(frame_of_any(X, "X")))
        values = torch.tensor(self.parameters_.to_numpy(dtype=np.float64))
        unit = context.space.to_unit(values.to(context.batch.leader_length))
        candidates = unit.expand(len(context.batch), 1, -1)
        with visit():
            losses = losses_of(
                context.calibrator, context.objective, context.batch, last, candidates
            )
        return -float(losses.mean())

    def _prepared(self, pairs: Pairs) -> tuple[ProtocolContext, Tensor]:
        """Returns the context with the calibrator of these pairs, and each pair's last frame."""
        chosen = {"model": self.model, "objective": self.objective, "seed": self.seed}
        settings = {"policy": "fixed", "protocol": "within_driver", **(self.settings or {})}
        with visit():
            experiment = config(pairs, **settings, **chosen)
            _, _, context = steps.without_files(experiment.config, pairs.selected)
        return context, Split.none(context.pairs, context.windows).frame

    def _pooled(self, pairs: Pairs) -> pd.Series:
        """Returns one set of parameters for all drivers, calibrated on whole trajectories."""
        context, last = self._prepared(pairs)
        members = torch.ones((1, len(context.pairs)), dtype=torch.bool)
        with visit():
            parameters = context.calibrator.pooled(context.pairs, context.batch, last, members)
        return pd.Series(parameters[0].tolist(), index=list(context.space.names))

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        tags.target_tags.required = False
        tags.no_validation = True
        return tags


def _pairs(table: Frame) -> Pairs:
    """Returns the pairs of a table; every row counts.

    Raises:
        CfxError: it is not in the tidy layout.
    """
    return read(table, min_duration=0)
