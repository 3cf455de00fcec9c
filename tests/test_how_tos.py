"""Each how-to runs as it is printed, on recordings of six made-up drivers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import cfx
from cfx.data.tidy import frame_of, write_tidy
from cfx.simulation.synthetic import SyntheticDataset
from tests.checkout import ROOT
from tests.printed import Reader, all_blocks

pytest.importorskip("cfx_sumo", reason="how-tos drive in SUMO")

from cfx_sumo.drive.scenarios import SCENARIOS

PAGES = sorted(path.stem for path in (ROOT / "docs" / "how-to").glob("*.md"))
RUN = {"sh", "python"}
"""Languages that run; `text` is for what needs the network or a person."""


def write_ngsim(pairs: cfx.plugin.PairSet, path: Path) -> None:
    """Writes pairs in NGSIM's 18 columns, in feet; each pair on a lane of its own."""
    feet = 0.3048
    lines = []
    for number, pair in enumerate(pairs):
        vehicles = (
            (pair.leader_position, pair.leader_speed, pair.leader_acceleration),
            (pair.follower_position, pair.follower_speed, pair.follower_acceleration),
        )
        for place, (position, speed, acceleration) in enumerate(vehicles):
            own, ahead, behind = 2 * number + 1 + place, 0, 2 * number + 2
            if place:
                ahead, behind = 2 * number + 1, 0
            for frame in range(len(position)):
                clock = 1113433136100 + 100 * frame
                y = position[frame] / feet
                row = (own, frame, len(position), clock, 0, f"{y:.3f}", 0, f"{y:.3f}", 15, 6, 2)
                tail = (f"{speed[frame] / feet:.3f}", f"{acceleration[frame] / feet:.3f}")
                lines.append(" ".join(map(str, (*row, *tail, number + 1, ahead, behind, 0, 0))))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_trips(pairs: cfx.plugin.PairSet, path: Path) -> None:
    """Writes pairs with names of columns of its owner's, speeds in km/h, and gaps alone."""
    frame = frame_of(pairs)
    gap = frame["leader_position_m"] - frame["leader_length_m"] - frame["follower_position_m"]
    trips = frame[["recording", "leader_id", "follower_id", "frame"]].copy()
    trips["trip"], trips["t"], trips["net_gap"] = frame["pair_id"], frame["time_s"], gap
    trips["v_kmh"] = frame["follower_speed_mps"] * 3.6
    trips["v_ahead"] = frame["leader_speed_mps"] * 3.6
    trips.to_csv(path, index=False)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Reader:
    folder = tmp_path_factory.mktemp("reader")
    write_recordings(folder)
    return Reader(folder)


def write_recordings(folder: Path) -> None:
    """Writes the files that the pages speak of."""
    made = SyntheticDataset(pairs=6, frames=720).load()
    write_tidy(made, folder / "pairs.parquet")
    write_ngsim(made, folder / "trajectories.txt")
    others = []
    for pair in SyntheticDataset(pairs=6, frames=720, seed=1).load():
        others.append(replace(pair, pair_id=f"other-{pair.pair_id}", recording="other"))
    write_tidy(cfx.plugin.PairSet(tuple(others), "other"), folder / "other.parquet")
    write_trips(made, folder / "trips.csv")
    SCENARIOS["motorway"].write(folder, 60.0).rename(folder / "my.sumocfg")


def test_there_are_about_twenty_pages_that_run() -> None:
    running = [page for page in PAGES if any(kind in RUN for kind, _ in all_blocks(name_of(page)))]
    assert len(running) >= 20


def name_of(page: str) -> str:
    """Returns the document of a how-to."""
    return f"docs/how-to/{page}.md"


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", PAGES)
def test_a_how_to_runs_as_printed(reader: Reader, page: str) -> None:
    for language, block in all_blocks(name_of(page)):
        if language == "sh":
            reader.shell(block)
        elif language == "python":
            reader.python(block)
