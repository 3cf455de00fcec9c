"""A parameter that recordings do not determine is marked in SUMO's vehicle types too."""

from __future__ import annotations

from pathlib import Path

from cfx_sumo.export import export


def test_vtypes_name_what_is_flat(flat_job: Path, tmp_path: Path) -> None:
    lines = export(flat_job, tmp_path / "drivers.add.xml")
    assert any("do not determine" in line and "b of 3" in line for line in lines)
    text = (tmp_path / "drivers.add.xml").read_text()
    assert text.count('<param key="flat" value="') == 3
