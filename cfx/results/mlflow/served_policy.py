"""The code that MLflow keeps beside a policy's weights ("models from code").

Loading such a model runs this file, never a pickle.
"""

from __future__ import annotations

from typing import Any

import mlflow.models
import pandas as pd
from mlflow.pyfunc.model import PythonModel, PythonModelContext


class ServedPolicy(PythonModel):
    """Predicts the parameters of the next window.

    In: measured history in the tidy pair layout. Out: a row per pair with `pair_id` and the
        parameters.
    """

    def load_context(self, context: PythonModelContext) -> None:
        from cfx.policies import checkpoint

        self._policy = checkpoint.load_agent(context.artifacts["policy"])

    def predict(
        self,
        context: PythonModelContext | None,
        model_input: pd.DataFrame,
        params: dict[str, Any] | None = None,
    ) -> pd.DataFrame:
        from cfx.policies.prediction import predict_frame

        return predict_frame(self._policy, model_input)


mlflow.models.set_model(ServedPolicy())
