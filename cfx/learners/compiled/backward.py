"""Back-propagation through a row of windows, by compiled code.

Truncated back-propagation through time (P. J. Werbos, 1990, *Backpropagation through time*,
Proceedings of the IEEE 78): gradients go from the last window to the first, and are scaled and
clipped between two of them (`cfx.learners.rollout.window.GradientPath`). Gradients by weights are
summed up behind it, as one product over all windows: `dW = x^T d(x W)`.

Shapes as in `cfx.learners.compiled.forward`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.core.threads import share
from cfx.learners.compiled.calls import Calls, Operand
from cfx.learners.compiled.forward import ForwardPass, rows, shards_of_networks
from cfx.learners.rollout.window import GradientPath


class BackwardPass:
    """Back-propagates through the windows of a forward pass, the last one first.

    Gradients by gates and answers take the places of these.

    Args:
        simulated: the forward pass, which has kept its values.
        path: how gradients go back.
        speed, gap: gradients by its results, `(N, D, frames)`.

    Attributes:
        by_weight: the gradient by each of the networks' weights.
    """

    def __init__(
        self, simulated: ForwardPass, path: GradientPath, speed: Tensor, gap: Tensor
    ) -> None:
        self.simulated, self.path = simulated, path
        self.speed, self.gap = speed, gap
        self.by_weight: dict[Tensor, Tensor] = {}
        for weight in simulated.window.network.parameters():
            self.by_weight[weight] = torch.zeros_like(weight)
        # Gradients by states have two slots: those of a window and of the one behind it.
        self.motion = speed.new_zeros((2, *simulated.motion.shape[1:]))
        self.carried = [torch.zeros_like(layer.carried[:, :2]) for layer in simulated.layers]

    def run(self) -> None:
        """Goes back through all windows."""
        observed, windows = self.simulated.observed, self.simulated.windows
        drive, observe = Calls(), Calls()
        if windows > observed:
            drive = self._calls(drives=True)
        if observed > 0:
            observe = self._calls(drives=False)

        def go_back(networks: slice) -> None:
            drive.run(range(windows - 1, observed - 1, -1), networks)
            observe.run(range(observed - 1, -1, -1), networks)
            for first, last in ((observed, windows), (0, observed)):
                if first < last:
                    self._add_to_weights(first, last, networks)

        share(go_back, shards_of_networks(self.simulated.shape[0]), level="scan")

    def _calls(self, *, drives: bool) -> Calls:
        """Returns what is computed in a window, in the reverse order of the forward pass."""
        calls, simulated, window = Calls(), self.simulated, self.simulated.window
        last = len(self.carried) - 1
        if drives:
            self._bound(calls)
            self._through_drive(calls)
        for number in range(last, -1, -1):
            layer, carried = simulated.layers[number], self.carried[number]
            projected, recurrent = rows(layer.projected), rows(layer.recurrent)
            to = [simulated.units(values) for values in (layer.projected, layer.recurrent, carried)]
            after, gates = simulated.units(carried, 1), simulated.gates(number, drives=drives)
            window.cell.backward(calls, gates, [after], to)
            before = rows(carried).only(simulated.outputs)
            calls.product(recurrent, layer.weights.w_hidden.mT, before, accumulates=True)
            if number > 0:
                below = rows(self.carried[number - 1], 1).only(simulated.outputs)
                calls.product(projected, layer.weights.w_input.mT, below, accumulates=True)
            elif drives:
                self._through_features(calls)
        return calls

    def _through_drive(self, calls: Calls) -> None:
        """Adds the gradients of a window's steps by the motion before it and by answers."""
        simulated, window = self.simulated, self.simulated.window
        gradients = list(simulated.columns(self.motion, 1).values())
        gradients += [simulated.frames(self.speed), simulated.frames(self.gap)]
        logits, to = simulated.in_driven(simulated.logits), simulated.columns(self.motion, 0)
        window.drive.backward(calls, simulated.surroundings, gradients, [*to.values(), logits])
        output = rows(self.carried[-1], 1).only(simulated.outputs)
        calls.product(logits, window.network.w_out.mT, output, accumulates=True)

    def _through_features(self, calls: Calls) -> None:
        """Adds the gradients of the first layer's inputs by the motion before a window."""
        simulated, first = self.simulated, self.simulated.layers[0]
        read = Operand(torch.empty_like(simulated.read[:, :1]))
        calls.product(rows(first.projected), first.weights.w_input.mT, read)
        through_features = simulated.columns(torch.empty_like(self.motion[:1]), 0)
        # Networks do not read the model's memory.
        through_features.pop("memory", None)
        to = list(through_features.values())
        simulated.window.features.backward(calls, simulated.surroundings, [read], to)
        before = simulated.columns(self.motion, 0)
        for name, gradient in through_features.items():
            calls.add(before[name], gradient)

    def _bound(self, calls: Calls) -> None:
        """Adds decay and clipping of gradients between windows; the last window has none."""
        path, last = self.path, self.simulated.windows - 1
        decay = path.decay if path.through_motion else 0.0
        for gradient in self.simulated.columns(self.motion, 1).values():
            calls.bound(gradient, decay, path.clip, except_window=last)
        for carried in self.carried:
            calls.bound(rows(carried, 1), path.decay, path.clip, except_window=last)

    def _add_to_weights(self, first: int, last: int, networks: slice) -> None:
        """Adds the contribution of some windows to the gradients by some networks' weights."""
        simulated, network = self.simulated, self.simulated.window.network
        drives = first >= simulated.observed
        for number, layer in enumerate(simulated.layers):
            weights = layer.weights
            # (N, windows, D, width) -> (N, windows D, width): rows of one product.
            projected = layer.projected[networks, first:last].flatten(1, 2)
            recurrent = layer.recurrent[networks, first:last].flatten(1, 2)
            if number > 0:
                below = simulated.layers[number - 1].carried[networks, first + 1 : last + 1]
                read = below[..., : network.hidden]
            elif drives:
                read = simulated.read[networks]
            else:
                read = simulated.inputs.features[:, networks].transpose(0, 1)
            before = layer.carried[networks, first:last, :, : network.hidden]
            self._of(weights.w_input, networks).baddbmm_(read.flatten(1, 2).mT, projected)
            self._of(weights.w_hidden, networks).baddbmm_(before.flatten(1, 2).mT, recurrent)
            bias = projected.sum(1, keepdim=True)
            self._of(weights.b_input, networks).add_(bias)
            self._of(weights.b_hidden, networks).add_(recurrent.sum(1, keepdim=True))
            if number == 0 and drives and network.b_acting is not None:
                self._of(network.b_acting, networks).add_(bias[:, None])
        if drives:
            carried = simulated.layers[-1].carried[networks, first + 1 : last + 1]
            outputs = carried[..., : network.hidden].flatten(1, 2)
            logits = simulated.logits[networks].flatten(1, 2)
            self._of(network.w_out, networks).baddbmm_(outputs.mT, logits)
            self._of(network.b_out, networks).add_(logits.sum(1, keepdim=True))

    def _of(self, weight: Tensor, networks: slice) -> Tensor:
        """Returns the part of a gradient that belongs to some networks."""
        return self.by_weight[weight][networks]
