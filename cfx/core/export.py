"""The contract of a format of `cfx export`.

A format is a class and its entry point, of any distribution:

    [project.entry-points."cfx.exports"]
    onnx = "cfx_onnx.export:OnnxExport"
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path


class ExportFormat(ABC):
    """Base of every format of `cfx export`, which goes by the name of its entry point.

    One is made without arguments for each call of the command.
    """

    @abstractmethod
    def write(self, run: str, output: Path | None) -> list[str]:
        """Writes a job's drivers for another program.

        Args:
            run: as the user names it: a job's folder, its URL, the id of its MLflow run, or
                `cfx://NAME`.
            output: the file; None: the format's own name for it.

        Returns:
            Sentences for the user.

        Raises:
            CfxError: the job cannot be read, or not be written in this format.
        """
