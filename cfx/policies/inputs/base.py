"""The contract of an input of policies: recent signals in, one number a frame out."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from cfx.core.component import Component
from cfx.data.signals import SIGNALS, Signal, further_signals
from cfx.errors import PluginError
from cfx.policies.history import History


class PolicyInput(Component):
    """Base of every input of policies, which `policy.inputs=[NAME]` chooses.

    Life cycle: an agent makes its policy's inputs once; training, evaluation and drivers elsewhere
    then ask for `values` in every window. An input is a pure function of tensors, elementwise over
    leading dimensions, so that it can be compiled, differentiated and exported.

    A subclass implements `values`. What networks read is normalised, so its scale does not matter;
    it must be finite at standstill and on a free road, where the gap is large.

    Attributes:
        unit: SI; "" for a number without one.
        meaning: in a few words.
        signals: that it reads: those of `cfx.plugin.SIGNALS`, or further ones, which it declares.
    """

    kind = "input"
    unit: ClassVar[str] = ""
    meaning: ClassVar[str] = ""
    signals: ClassVar[tuple[Signal, ...]] = ()

    @abstractmethod
    def values(self, history: History) -> Tensor:
        """Returns the input at each frame, `(*batch, L)`, in the dtype of the history.

        Args:
            history: the last L frames of the signals, `(*batch, L)` each, SI units.
        """

    @classmethod
    def further_signals(cls) -> tuple[Signal, ...]:
        """Returns the signals that it reads beyond those of every recording."""
        return further_signals(cls.signals)

    @classmethod
    def complaint(cls) -> str:
        declared: tuple[object, ...] = cls.signals  # by a third party
        for signal in declared:
            if not isinstance(signal, Signal):
                return (
                    f" reads {signal!r}, which is no cfx.plugin.Signal; name signals as in"
                    f" signals = (SIGNALS['gap'],), with one of {', '.join(SIGNALS)}"
                )
        if not cls.signals or not cls.meaning:
            return " does not say which signals it reads (`signals`) and what it means (`meaning`)"
        try:
            cls.further_signals()
        except PluginError as error:
            return f": {error}"
        return ""
