"""Columns that several tables have."""

from __future__ import annotations

from cfx.results.table import Column

PAIR = Column("pair_id", "", "the pair of leader and follower", "text")
DRIVER = Column("driver", "", "the follower of the pair", "text")
METHOD = Column("method", "", "what chose the parameters", "text")
TIME = Column("time_s", "s", "time since the start of the pair")
