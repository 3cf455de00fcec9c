"""What the section shows, and where it shows nothing."""

from types import SimpleNamespace

import cfx
import pandas as pd
import pytest

pytest.importorskip("cfx_report", reason="the section is one of cfx-report's page")

from cfx_example.section import MeasuredSpeeds


def test_cfx_finds_it():
    found = cfx.get("section", "measured_speeds")
    assert found is MeasuredSpeeds, "install it first: pip install --editable ."


def test_the_frames_of_all_bins_are_added_up():
    bins = pd.DataFrame({"speed": [0.0, 3.0], "frames": [100, 50]})
    job = SimpleNamespace(name="a", tables={"speed_bins": bins})
    context = MeasuredSpeeds().context(SimpleNamespace(jobs=(job,)))
    ((name, frames, highest),) = context["sheet"].rows
    assert (name.text, frames.text, highest.text) == ("a", "150", "3")


def test_jobs_without_the_table_have_none():
    job = SimpleNamespace(name="a", tables={})
    assert MeasuredSpeeds().context(SimpleNamespace(jobs=(job,))) is None
