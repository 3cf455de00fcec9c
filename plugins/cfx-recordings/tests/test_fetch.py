"""Downloading I-80 from a service on this machine that speaks and fails as the real one may."""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
import socket
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from cfx.app import cli
from cfx.errors import CfxError, ConfigError, DataError, OutputError
from cfx_recordings.fetch import COLUMNS, fetch_ngsim_i80
from cfx_recordings.ngsim import read_ngsim

STARTS = {"0400": 1_113_433_200_000, "0500": 1_113_436_800_000, "0515": 1_113_437_700_000}
Row = dict[str, str]


def vehicle(
    number: int, leader: int, frames: range, recording: str, ahead: float, place: str = "i-80"
) -> list[Row]:
    """A vehicle at 30 ft/s; frame 0 lies half a minute before the recording's nominal beginning."""
    known = {
        "Vehicle_ID": number,
        "Total_Frames": len(frames),
        "v_Length": 15,
        "v_Vel": 30,
        "Lane_ID": 2,
        "Preceding": leader,
    }
    clock = STARTS[recording] - 30_000
    return [
        {name: str(known.get(name, 0)) for name in COLUMNS}
        | {
            "Frame_ID": str(k),
            "Global_Time": str(clock + 100 * k),
            "Local_Y": f"{ahead + 3 * k:.3f}",
            "Location": place,
        }
        for k in frames
    ]


def recordings() -> list[Row]:
    """Three recordings, of which the last two overlap in time, and another place."""
    rows = [*vehicle(1, 0, range(10, 40), "0400", 100), *vehicle(2, 1, range(10, 40), "0400", 50)]
    # At 5:15:05 pm a vehicle of the one recording is still in the picture, and the same id of the
    # next already.
    rows += vehicle(1, 0, range(9_300, 9_340), "0500", 200)
    rows += vehicle(1, 0, range(300, 340), "0515", 300)
    rows += vehicle(9, 0, range(10, 20), "0400", 0, place="us-101")
    return rows


class Soda:
    """A data set behind SODA's interface, as CSV with every cell quoted.

    It knows `$select`, `$where`, `$order`, `$limit` and `$offset`.

    Attributes:
        faults: what the next pages get instead of a right answer, in order; None is a right answer.
        counts: what the next questions for the number of rows get, in order.
        pages: the offsets asked for.
        tokens: the application tokens sent along.
    """

    def __init__(self, rows: list[Row]) -> None:
        self.rows = rows
        self.faults: list[str | None] = []
        self.counts: list[int] = []
        self.pages: list[int] = []
        self.tokens: list[str | None] = []
        self.url = ""

    def answer(self, handler: BaseHTTPRequestHandler) -> None:
        asked = {name: values[0] for name, values in parse_qs(urlsplit(handler.path).query).items()}
        self.tokens.append(handler.headers["X-App-Token"])
        chosen = list(filter(where(asked["$where"]), self.rows))
        if asked["$select"] == "count(*)":
            number = self.counts.pop(0) if self.counts else len(chosen)
            return send(handler, 200, f'"count"\n"{number}"\n')
        assert asked["$order"] == ":id"
        offset, limit = int(asked["$offset"]), int(asked["$limit"])
        self.pages.append(offset)
        fault = self.faults.pop(0) if self.faults else None
        names = asked["$select"].split(",")
        by_name = {name.lower(): name for name in COLUMNS}
        table = [[row[by_name[name]] for name in names] for row in chosen[offset : offset + limit]]
        if fault == "a row too few":
            table.pop()
        out = io.StringIO()
        csv.writer(out, quoting=csv.QUOTE_ALL, lineterminator="\n").writerows([names, *table])
        return self.send_page(handler, fault, out.getvalue())

    @staticmethod
    def send_page(handler: BaseHTTPRequestHandler, fault: str | None, text: str) -> None:
        if fault in {"429", "503", "202"}:
            send(handler, int(fault), "busy", **{"Retry-After": "0"})
        elif fault == "400":
            send(
                handler,
                400,
                json.dumps({"message": "Query coordinator error: query.soql.no-such-column"}),
            )
        elif fault == "a log-in page":
            send(handler, 200, "<!DOCTYPE html>\n<title>Please log in</title>\n")
        elif fault == "a broken connection":
            send(handler, 200, text[:-30], **{"Content-Length": str(len(text))})
        else:
            send(handler, 200, text)


def where(soql: str) -> Callable[[Row], bool]:
    """Understands the little of SoQL that is used."""
    found = re.fullmatch(
        r"location='([\w-]+)'(?: AND global_time >= (\d+) AND global_time <= (\d+))?", soql
    )
    assert found, soql
    place, first, last = found[1], int(found[2] or 0), int(found[3] or 10**15)
    return lambda row: row["Location"] == place and first <= int(row["Global_Time"]) <= last


def send(handler: BaseHTTPRequestHandler, status: int, text: str, **headers: str) -> None:
    handler.send_response(status)
    for name, value in (
        {"Content-Type": "text/csv", "Content-Length": str(len(text))} | headers
    ).items():
        handler.send_header(name, value)
    handler.end_headers()
    handler.wfile.write(text.encode())


@pytest.fixture
def soda(monkeypatch: pytest.MonkeyPatch) -> Iterator[Soda]:
    """Serves the three recordings."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    service = Soda(recordings())

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            service.answer(self)

        def log_message(self, *_: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        service.url = f"http://127.0.0.1:{server.server_port}/resource/8ect-6jqj.csv"
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield service
        server.shutdown()
        thread.join()


@pytest.fixture
def fetch(soda: Soda, tmp_path: Path) -> Callable[..., Path]:
    """Fetches in small pages, without waiting."""

    def run(recording: str = "0400", **options: Any) -> Path:
        return fetch_ngsim_i80(
            tmp_path / "data",
            recording,
            **({"url": soda.url, "page_rows": 25, "wait_s": 0.0} | options),
        )

    return run


def rows_in(path: Path) -> list[Row]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def names_in(folder: Path) -> list[str]:
    return sorted(one.name for one in folder.iterdir())


def test_the_command_downloads_a_file_that_jobs_read_as_it_is(
    soda: Soda, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOCRATA_APP_TOKEN", "a token")
    assert cli.main(["data", "fetch", "ngsim-i80", "--url", soda.url]) == 0
    said = capsys.readouterr()
    assert (
        said.out.splitlines()[-1]
        == "Use it: python -m cfx data=ngsim data.path=data/ngsim-i80-0400.csv"
    )
    assert "60 rows in 1 page" in said.out
    assert said.err == ""
    assert set(soda.tokens) == {"a token"}
    (pair,) = read_ngsim(tmp_path / "data" / "ngsim-i80-0400.csv").pairs()
    assert (pair.recording, pair.leader_id, pair.follower_id, len(pair)) == ("i-80", "1", "2", 30)
    assert cli.main(["data", "describe", "data/ngsim-i80-0400.csv"]) == 0
    assert "Use it: data=ngsim data.path=data/ngsim-i80-0400.csv" in capsys.readouterr().out


def test_pages_are_joined_in_order_and_whole(
    soda: Soda, fetch: Callable[..., Path], tmp_path: Path
) -> None:
    path = fetch()
    assert rows_in(path) == [row for row in soda.rows if row["Location"] == "i-80"][:60]
    assert path.read_text().splitlines()[0] == ",".join(COLUMNS)
    assert soda.pages == [0, 25, 50]
    assert set(soda.tokens) == {None}
    assert names_in(tmp_path / "data") == ["ngsim-i80-0400.csv"]


def test_recordings_that_overlap_in_time_are_told_apart(
    soda: Soda, fetch: Callable[..., Path]
) -> None:
    rows = [row for row in soda.rows if row["Location"] == "i-80"]
    assert rows_in(fetch("0500")) == rows[60:100]
    assert rows_in(fetch("0515")) == rows[100:]
    assert rows_in(fetch("all")) == rows
    assert read_ngsim(fetch("all")).recordings == ("i-80-1", "i-80-2", "i-80-3")


def test_a_recording_that_would_be_cut_is_refused(
    soda: Soda, fetch: Callable[..., Path], tmp_path: Path
) -> None:
    soda.rows += vehicle(3, 0, range(300, 16_000), "0400", 0)
    with pytest.raises(
        DataError, match="recording 0400 is longer than known and would be cut; use --recording all"
    ):
        fetch(page_rows=10_000)
    assert "ngsim-i80-0400.csv" not in names_in(tmp_path / "data")


def test_a_busy_service_and_a_broken_connection_are_asked_again(
    soda: Soda, fetch: Callable[..., Path]
) -> None:
    soda.faults = ["429", "503", "202", None, "a broken connection", None, "a row too few"]
    assert len(rows_in(fetch())) == 60
    assert soda.pages == [0, 0, 0, 0, 25, 25, 50, 50]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("503", "cannot be reached: it answers 503 Service Unavailable, again and again"),
        ("400", "refuses the query .400 Query coordinator error: query.soql.no-such-column."),
        ("a log-in page", "something else than the data set's columns: '<!DOCTYPE html>'"),
        ("a row too few", "sent 24 instead of 25 rows from row 25 on, 3 times"),
        ("a broken connection", "cannot be reached: .*[Rr]ead"),
    ],
)
def test_a_download_that_is_broken_off_goes_on_where_it_was(
    soda: Soda, fetch: Callable[..., Path], tmp_path: Path, fault: str, message: str
) -> None:
    soda.faults = [None, *[fault] * 10]
    with pytest.raises(DataError, match=message) as caught:
        fetch()
    assert "\n" not in str(caught.value)
    assert names_in(tmp_path / "data") == ["ngsim-i80-0400.pages"]
    soda.faults, soda.pages = [], []
    assert len(rows_in(fetch())) == 60
    assert soda.pages == [25, 50]


def test_a_page_that_was_damaged_meanwhile_is_fetched_again(
    soda: Soda, fetch: Callable[..., Path], tmp_path: Path
) -> None:
    soda.faults = [None, None, "400"]
    with pytest.raises(DataError):
        fetch()
    page = tmp_path / "data" / "ngsim-i80-0400.pages" / "000000000.csv"
    page.write_text("".join(page.read_text().splitlines(keepends=True)[:7]))
    soda.pages = []
    assert len(rows_in(fetch())) == 60
    assert soda.pages == [0, 50]


def test_data_that_changes_during_the_download_is_refused_and_fetched_anew(
    soda: Soda, fetch: Callable[..., Path], tmp_path: Path
) -> None:
    soda.counts = [60, 90]
    with pytest.raises(
        DataError,
        match="had 60 rows when the download began and has 90 now; run the same command again",
    ):
        fetch()
    assert names_in(tmp_path / "data") == ["ngsim-i80-0400.pages"]
    soda.rows[60:60] = vehicle(3, 2, range(10, 40), "0400", 0)
    soda.pages = []
    assert len(rows_in(fetch())) == 90
    assert soda.pages == [0, 25, 50, 75]


def test_a_finished_file_is_replaced_only_when_told(
    soda: Soda, fetch: Callable[..., Path], tmp_path: Path
) -> None:
    path = tmp_path / "data" / "ngsim-i80-0400.csv"
    path.parent.mkdir()
    path.write_text("mine")
    assert fetch() == path
    assert (path.read_text(), soda.tokens) == ("mine", [])
    soda.faults = ["400"]
    with pytest.raises(DataError):
        fetch(force=True)
    assert path.read_text() == "mine"
    assert len(rows_in(fetch(force=True))) == 60


def test_without_a_connection_one_sentence_says_what_to_do(
    tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    with socket.socket() as smoke_check:
        smoke_check.bind(("127.0.0.1", 0))
        port = smoke_check.getsockname()[1]
    assert cli.main(["data", "fetch", "ngsim-i80", "--url", f"http://127.0.0.1:{port}/x.csv"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert line.startswith(f"127.0.0.1:{port} cannot be reached: ")
    assert (
        "download https://data.transportation.gov/api/views/8ect-6jqj/rows.csv?accessType=DOWNLOAD"
        " by hand" in line
    )
    assert "data=ngsim data.path=FILE" in line
    assert names_in(tmp_path) == []


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"recording": "0430"}, ConfigError, "known are 0400, 0500, 0515, all"),
        ({"url": "8ect-6jqj"}, ConfigError, "--url 8ect-6jqj is no address"),
    ],
)
def test_wrong_options_say_so(
    fetch: Callable[..., Path], options: dict[str, str], error: type[CfxError], message: str
) -> None:
    with pytest.raises(error, match=message):
        fetch(**options)


def test_a_service_without_the_recording_and_a_folder_that_is_a_file_say_so(
    soda: Soda, fetch: Callable[..., Path], tmp_path: Path
) -> None:
    (tmp_path / "data").write_text("in the way")
    with pytest.raises(OutputError, match=r"data cannot be written .*; name another --folder"):
        fetch()
    soda.rows = []
    with pytest.raises(DataError, match="has no rows for location='i-80'"):
        fetch()


def test_real_rows_come_through_unchanged(
    soda: Soda, fetch: Callable[..., Path], shared_data: Path
) -> None:
    sample = shared_data / "i80_0400_raw_sample.csv.gz"
    with gzip.open(sample, "rt", newline="") as file:
        rows = [row | {"Location": "i-80"} for row in csv.DictReader(file)]
    soda.rows = [row for row in rows if row["Lane_ID"] == "2"]
    fetched = read_ngsim(fetch(page_rows=50_000)).pairs()
    original = [pair for pair in read_ngsim(sample).pairs() if pair.lane == 2]
    assert len(fetched) == len(original) > 10
    for ours, theirs in zip(fetched, original, strict=True):
        assert (ours.leader_id, ours.follower_id) == (theirs.leader_id, theirs.follower_id)
        assert (ours.gap == theirs.gap).all()
