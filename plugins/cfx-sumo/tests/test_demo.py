from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import cfx
from cfx.errors import ConfigError, DataError, SumoError
from cfx.policies.checkpoint import save_agent
from cfx_sumo.demo import motorway
from cfx_sumo.demo.demo import SumoDemo
from cfx_sumo.demo.motorway import SHIPPED, find_netconvert, read_motorway
from cfx_sumo.demo.replay import FOLLOWERS, ReplayRequest
from cfx_sumo.demo.simulated import ask
from tests.agents import adaptive
from tests.browser import Browser
from tests.drives import straight_pairs

pytest.importorskip("sumolib", reason="needs the extra sumo")

SMALL = [
    "optimizer=random",
    "optimizer.samples=32",
    "figures=none",
    "tracking.enabled=false",
    "learner.epochs=3",
    "calibration.prior=none",
]
OSM = SHIPPED.with_name("motorway.osm.xml")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a job with its demonstration."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("demo"))
        return cfx.run(
            ["experiment=sumo_demo", "data.pairs=5", "data.frames=150", "demo.pairs=3", *SMALL]
        ).folder


def test_the_demonstration_has_the_errors_of_the_evaluation(demo: Path) -> None:
    table = pd.read_csv(demo / "sumo" / "demo_rmse.csv").set_index(["pair_id", "method"])
    assert len(table) == 3 * 2
    memory = pd.read_csv(demo / "pairs.csv").set_index(["pair_id", "method"])
    for column in ("rmse_speed", "rmse_gap"):
        assert table[f"{column}_memory"].to_numpy() == pytest.approx(
            memory.loc[table.index, column].to_numpy(), abs=1e-12
        )
        # The networks are in single precision, and are asked about other numbers of drivers at
        # once.
        assert table[f"{column}_sumo"].to_numpy() == pytest.approx(
            table[f"{column}_memory"].to_numpy(), abs=1e-4
        )
    assert (table["frames"] > 20).all()
    default = table.xs("default", level="method")
    assert default["difference_speed"].max() < 1e-9
    assert default["difference_gap"].max() < 1e-9


@pytest.mark.slow
def test_offsets_start_in_sumo_from_what_they_start_from_in_the_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the driver's own set, shrunk as in training: not the calibrated set itself."""
    monkeypatch.chdir(tmp_path)
    learner = ["learner=rollout", "learner.ensemble_size=2", "learner.steps=2", "learner.horizon=6"]
    protocol = ["protocol=across_drivers", "protocol.folds=2", "protocol.histories=[]"]
    few = ["data.pairs=4", "data.frames=150", "demo.pairs=1"]
    folder = cfx.run(["experiment=sumo_demo", *few, *SMALL, *learner, *protocol]).folder
    table = pd.read_csv(folder / "sumo" / "demo_rmse.csv").set_index("method").loc["policy"]
    assert float(table["rmse_speed_sumo"]) == pytest.approx(
        float(table["rmse_speed_memory"]), abs=1e-4
    )
    rows = pd.read_csv(folder / "pairs.csv").set_index(["pair_id", "method"])
    base, fixed = (
        float(rows.loc[(table["pair_id"], method), "rmse_speed"])
        for method in ("shrunk", "driver_specific")
    )
    assert base != pytest.approx(fixed, abs=1e-2)


def test_its_pictures_and_its_road_are_there(demo: Path) -> None:
    assert {path.name for path in (demo / "sumo").iterdir()} == {
        "demo.html",
        "demo.png",
        "demo_drives.png",
        "demo_rmse.csv",
        "motorway.net.xml",
    }
    for name in ("demo.png", "demo_drives.png"):
        assert (demo / "sumo" / name).read_bytes().startswith(b"\x89PNG")
    assert (demo / "sumo" / "motorway.net.xml").read_bytes() == SHIPPED.read_bytes()


def test_the_animation_is_complete_in_itself_and_plays(demo: Path, browser: Browser) -> None:
    from playwright.sync_api import expect

    page = browser.page
    page.goto((demo / "sumo" / "demo.html").as_uri())
    page.wait_for_selector("#plot .view:visible svg")
    assert page.locator("#pair option").count() == 3
    page.locator("#time").fill("130")
    before, pictured = (
        page.inner_text("#clock"),
        page.evaluate("document.getElementById('road').toDataURL()"),
    )
    assert before == "13.0 s of 14.9 s"
    assert "the models have taken over" in page.inner_text("#state")
    page.locator("#play").click()
    expect(page.locator("#clock")).not_to_have_text(before)
    assert page.evaluate("document.getElementById('road').toDataURL()") != pictured
    expect(page.locator("#play")).to_have_text("Play", timeout=30_000)  # it ends by itself
    assert page.inner_text("#clock") == "14.9 s of 14.9 s"
    page.locator("#pair").select_option("2")
    assert "take over in 3.0 s" in page.inner_text("#state")
    assert page.locator("tbody tr").count() == 6
    assert page.locator(".now").count() == 11, "a cursor in speed, gap and each of nine parameters"
    assert browser.errors == []
    assert browser.over_network() == []


def test_the_road_is_six_tracks_through_an_on_ramp() -> None:
    road = read_motorway(None, Path())
    assert road.edges == ("1001", "1002", "1003")
    assert road.tracks == tuple((k, k + 1, k) for k in range(6)), (
        "where the ramp joins, lanes are numbered anew"
    )
    assert road.length > 3000
    inside = float((road.ends[0, 0] + road.starts[0, 1]) / 2)
    assert road.place(0, inside) is None
    assert road.place(0, float(road.starts[0, 1]) + 10) == (1, pytest.approx(10))
    assert road.place(0, road.length + 1) is None


def test_an_extract_of_ones_own_becomes_a_road(tmp_path: Path) -> None:
    if find_netconvert() is None:
        pytest.skip("netconvert is not here: pip install eclipse-sumo")
    own = shutil.copy(OSM, tmp_path / "own.osm")
    road, shipped = read_motorway(Path(own), tmp_path), read_motorway(None, tmp_path)
    assert (road.edges, road.tracks) == (shipped.edges, shipped.tracks)
    np.testing.assert_allclose(road.ends, shipped.ends, atol=0.01)
    (tmp_path / "torn.osm").write_text(OSM.read_text()[:2000])
    with pytest.raises(
        DataError, match=r"torn.osm is no OpenStreetMap extract that netconvert can read: "
    ):
        read_motorway(tmp_path / "torn.osm", tmp_path)


def test_a_network_of_ones_own_is_a_road(tmp_path: Path) -> None:
    own = Path(shutil.copy(SHIPPED, tmp_path / "own.net.xml"))
    assert read_motorway(own, tmp_path).net == own


def test_what_is_no_road_is_one_sentence_before_the_work_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.osm").write_text("a map")
    Path("torn.net.xml").write_text(SHIPPED.read_text()[:9000])
    Path("narrow.net.xml").write_text(SHIPPED.read_text().replace("passenger", "tram"))
    pairs = straight_pairs([60])
    for name, sentence in {
        "text.osm": r"demo.osm=text.osm is no OpenStreetMap extract: it holds no <osm> element",
        "none.osm": r"demo.osm=none.osm cannot be read \(No such file or directory\)",
        "torn.net.xml": r"torn.net.xml is no network that SUMO can read",
        "narrow.net.xml": r"narrow.net.xml has no road of 3 lanes or more for cars",
    }.items():
        with pytest.raises(DataError, match=sentence):
            SumoDemo(osm=Path(name)).check(pairs)
    monkeypatch.setattr(motorway, "find_netconvert", lambda: None)
    with pytest.raises(
        SumoError, match="needs SUMO's netconvert, which is not here: pip install eclipse-sumo"
    ):
        SumoDemo(osm=OSM).check(pairs)
    with pytest.raises(DataError, match="it holds no <osm> element"):
        cfx.run(["experiment=sumo_demo", "demo.osm=text.osm", *SMALL])
    assert not list(Path("outputs").rglob("pairs.csv"))
    with pytest.raises(ConfigError, match=r"demo\.pairs"):
        cfx.run(["experiment=sumo_demo", "demo.pairs=0", *SMALL])


def test_pairs_that_the_road_is_too_short_for_are_not_shown(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    short = tmp_path / "short.net.xml"
    text = SHIPPED.read_text()
    for length, shorter in (("858.03", "58.03"), ("384.70", "38.47"), ("1953.11", "195.31")):
        text = text.replace(f'length="{length}"', f'length="{shorter}"')
    short.write_text(text)
    demo = SumoDemo(osm=short)
    with caplog.at_level("INFO", "cfx_sumo"):
        demo.check(straight_pairs([200, 300]))
    assert "1 pairs are not shown" in caplog.text
    with pytest.raises(
        DataError,
        match=r"the motorway has 305 m, the pair with the shortest way takes 354 m; name an extract",
    ):
        demo.check(straight_pairs([300]))


def test_what_sumo_refuses_is_one_sentence() -> None:
    signals = np.stack([np.arange(30.0), np.full(30, 10.0), np.zeros(30)])
    tracks = dict.fromkeys(FOLLOWERS, 0)
    pair = {
        "scene": 0,
        "length": 5.0,
        "first": 5,
        "network": "all",
        "base": None,
        "driver_features": None,
        "renew": 0,
        "track": tracks,
        "places": {kind: [(0, 60), (0, 30)] for kind in FOLLOWERS},
    }
    header = {
        "dt": 0.1,
        "net": str(SHIPPED),
        "edges": ["nowhere"],
        "tracks": [[0, 0, 0]],
        "pairs": [pair],
    }
    with tempfile.TemporaryDirectory() as folder:
        save_agent(adaptive({"name": "krauss"}), Path(folder))
        with pytest.raises(
            SumoError,
            match=r"^SUMO lost a vehicle or refuses one \(The edge 'nowhere' within the route 'from0'",
        ) as error:
            ask(
                ReplayRequest(
                    header | {"policy": folder},
                    {"0/leader": np.add(signals, [[30], [0], [0]]), "0/follower": signals},
                )
            )
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_real_leaders_are_followed_in_sumo_as_in_memory(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    data = [
        "data=tidy",
        f"data.path={shared_data / 'i80_reconstructed_pairs.parquet'}",
        "data.min_duration=70",
        "data.max_pairs=6",
    ]
    result = cfx.run(["experiment=sumo_demo", *data, *SMALL])
    table = pd.read_csv(result.folder / "sumo" / "demo_rmse.csv")
    assert len(table) == 12
    assert table["difference_speed"].max() < 1e-4
    assert table["difference_gap"].max() < 1e-3
