"""Which of a driving model's limits SUMO does not keep to."""

from __future__ import annotations

from cfx.plugin import DrivingModel, LimitSettings, VType


def lost_limits(model: DrivingModel, kind: VType) -> list[str]:
    """Returns the limits that somebody has changed and that SUMO knows nothing of, as `key=value`.

    SUMO keeps to a vType's accel, decel and emergencyDecel, whose default values are those of
    `model.limits`. `comfortable_deceleration` is of live driving alone.

    Args:
        model: the driving model.
        kind: its vehicle type.
    """
    limits, usual = model.limits, LimitSettings()
    if limits is None:
        return []
    lost = []
    for name in ("acceleration", "emergency_deceleration", "response_time"):
        value = getattr(limits, name)
        if name == "emergency_deceleration" and kind.attributes.get("emergencyDecel") == repr(
            value
        ):
            continue
        if value != getattr(usual, name):
            lost.append(f"model.limits.{name}={value:g}")
    return lost
