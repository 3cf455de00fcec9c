"""The table of learning curves."""

from __future__ import annotations

from cfx.evaluation.result import Evaluation
from cfx.learners.curves import best_losses
from cfx.results.table import Column, ResultTable


class Curves(ResultTable):
    """Learning curves; without rows where nothing was learned."""

    meaning = (
        "learning curves; of heads that draw also of how many sampled paths the CRPS is in an"
        " epoch's training loss"
    )
    order = 40
    always = True
    columns = (
        Column("network", "", "which of the networks", "text"),
        Column("epoch", "1", "from 0", "int"),
        Column("train_loss", "as of the loss", "mean over the training windows"),
        Column("validation_loss", "as of the loss", "mean over the validation windows"),
        Column("sampled_paths", "1", "paths per window in the CRPS", "int", required=False),
    )

    def metrics(self, evaluation: Evaluation) -> dict[str, float]:
        return best_losses(evaluation.tables["curves"])
