"""Driving styles of sites: who is compared with whom, how far apart, and in what."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfx.app import cli
from cfx.data.pairs import Pair, PairSet
from cfx.data.style import (
    StyleResult,
    StyleSettings,
    groups,
    measure_style,
    style_distances,
    styles_by_site,
)
from cfx.data.tidy import write_tidy
from tests.data.test_style import a_pair


def drive(name: str, site: str, speed: float, kind: str = "", seed: int = 0) -> Pair:
    rng = np.random.default_rng(seed)
    wave = speed + 0.3 * np.sin(np.arange(80) * 0.1 + rng.uniform(0, 6))
    one = a_pair(name, wave, acceleration=np.gradient(wave, 0.1))
    return replace(one, site=site, driver_type=kind)


def of_sites(speeds: dict[str, float], drivers: int = 12) -> StyleResult:
    """Scores drivers that differ from site to site in their mean speed alone."""
    pairs = []
    for site, mean in speeds.items():
        for number in range(drivers):
            rng = np.random.default_rng(number)
            pairs.append(drive(f"{site}{number}", site, mean + rng.normal(), seed=number))
    return measure_style(PairSet(tuple(pairs), "x"), StyleSettings())


def test_sites_that_differ_in_speed_alone_are_told_apart_by_it() -> None:
    distances = style_distances(of_sites({"town": 10.0, "road": 20.0}))
    assert distances is not None
    (row,) = distances.to_dict("records")
    assert row["most"] == "mean_speed"
    assert row["p_value"] < 0.01
    assert row["distance_mean_speed"] > 10 * row["distance_variance_speed"]


def test_the_same_drivers_at_two_sites_are_not_told_apart() -> None:
    distances = style_distances(of_sites({"a": 10.0, "b": 10.0}))
    assert distances is not None
    assert distances["distance"].item() == pytest.approx(0, abs=1e-6)
    assert distances["p_value"].item() > 0.5


def test_types_of_drivers_are_compared_within_their_site() -> None:
    pairs = [drive(f"p{n}", "track", 10 + n, "human", n) for n in range(4)]
    pairs += [drive(f"c{n}", "track", 20 + n, "acc", n) for n in range(4)]
    pairs += [drive(f"r{n}", "road", 15 + n, "human", n) for n in range(4)]
    style = measure_style(PairSet(tuple(pairs), "x"), StyleSettings())
    table, distances = styles_by_site(style), style_distances(style)
    assert table is not None
    assert distances is not None
    named = list(zip(table["site"], table["driver_type"], table["drivers"], strict=True))
    assert named == [
        ("track", "all", 8),
        ("track", "human", 4),
        ("track", "acc", 4),
        ("road", "all", 4),
    ]
    assert table["mean_speed"].to_numpy() == pytest.approx([16.5, 11.5, 21.5, 16.5], abs=0.3)
    assert list(distances["other_driver_type"]) == ["all", "acc"]


def test_a_driver_of_two_sites_belongs_to_both() -> None:
    pairs = [drive("a", "road", 10.0), drive("b", "road", 12.0), drive("c", "town", 9.0)]
    both = replace(drive("a", "town", 11.0), pair_id="again")
    style = measure_style(PairSet((*pairs, both), "x"), StyleSettings())
    assert {group.site: int(group.chosen.sum()) for group in groups(style.table)} == {
        "road": 2,
        "town": 2,
    }


def test_one_site_alone_has_nothing_to_compare() -> None:
    style = of_sites({"road": 10.0})
    assert styles_by_site(style) is None
    assert style_distances(style) is None


def test_describe_compares_the_sites_of_several_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = []
    for site, mean in {"town": 10.0, "road": 20.0}.items():
        pairs = [drive(f"{site}{n}", "", mean + n, "human", n) for n in range(5)]
        recorded = [replace(pair, recording=site) for pair in pairs]
        write_tidy(PairSet(tuple(recorded), site), tmp_path / f"{site}.csv")
        names.append(str(tmp_path / f"{site}.csv"))
    figure = tmp_path / "sites.svg"
    assert cli.main(["data", "describe", *names, "--style", "--figure", str(figure)]) == 0
    printed = capsys.readouterr().out
    assert "By site" in printed
    assert [line.split()[-2:] for line in printed.splitlines() if line.startswith(" town  ")][
        -1
    ] == [
        "mean",
        "speed",
    ]
    assert figure.read_bytes().startswith(b"<?xml")
    assert cli.main(["data", "describe", *names, "--figure", str(tmp_path / "sites.doc")]) == 2
    refused = capsys.readouterr()
    assert ".png, .svg, .pdf" in refused.err
    assert not refused.out, "a figure's ending is checked before a file is read"
    assert cli.main(["data", "describe", names[0], "--style"]) == 2
    assert "one alone" in capsys.readouterr().err
    assert cli.main(["data", "describe", names[0], names[0]]) == 0
    assert "stands in" in capsys.readouterr().out
