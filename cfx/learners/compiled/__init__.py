"""The closed loop of recurrent networks as compiled code: a room that training can do without.

The door is `compile_windows` and the two functions that a compiled window has: `trajectories` and
`gradients`. Nothing outside imports anything below it. Without the room, with
`learner.compile=torch`, without a C++ compiler, on a GPU and for networks that are not recurrent
PyTorch takes the same steps: the eager twin is `cfx.learners.rollout.loop`, and tests hold both
equal.

Within, from the bottom up: `adjoint` differentiates an elementwise function that was recorded,
`elementwise` writes and builds both as C++; `calls` runs these and matrix products window by
window (`calls.cpp`). `window` says which functions a window consists of, `forward` simulates a row
of windows, `backward` goes back through them, and `loop` makes trajectories of it.
"""

from __future__ import annotations

from cfx.learners.compiled.loop import compile_windows

__all__ = ["compile_windows"]
"""The door."""
