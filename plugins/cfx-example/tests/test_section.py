"""What the section shows."""

from types import SimpleNamespace

import cfx
import pandas as pd
import pytest

pytest.importorskip("cfx_report", reason="the section is one of cfx-report's page")

from cfx_example.section import FrameCounts


def test_cfx_finds_it():
    found = cfx.get("section", "frames")
    assert found is FrameCounts, "install it first: pip install --editable ."


def test_the_frames_of_all_pairs_are_added_up():
    pairs = pd.DataFrame({"method": ["default", "fixed", "default"], "frames": [100, 100, 50]})
    context = FrameCounts().context(SimpleNamespace(jobs=(SimpleNamespace(name="a", pairs=pairs),)))
    ((name, frames),) = context["sheet"].rows
    assert (name.text, frames.text) == ("a", "150")
