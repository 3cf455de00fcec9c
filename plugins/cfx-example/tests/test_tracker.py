"""What is kept of runs, and what is said of those that are not there."""

import subprocess
import sys
from types import SimpleNamespace

import cfx
import pytest
from cfx.errors import TrackingError

from cfx_example.tracker import FILE, RunList


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A job's folder, where jobs are started in the one above."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "job").mkdir()
    return tmp_path / "job"


def track(folder, metrics, uri=None):
    """Runs a job; returns the id of its run."""
    config = SimpleNamespace(tracking=SimpleNamespace(uri=uri))
    with RunList().run(config, folder) as tracker:
        tracker.set_tags({"dataset.pairs": "2"})
        tracker.log_job(SimpleNamespace(metrics=metrics), "")
    return tracker.run_id


def test_cfx_finds_it():
    found = cfx.get("tracker", "run_list")
    assert found is RunList, "install it first: pip install --editable ."


def test_it_needs_no_pyarrow_which_does_not_get_on_with_sumo():
    script = "import sys; sys.modules['pyarrow'] = None; import cfx_example.tracker"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_a_run_leads_to_its_job(folder):
    run_id = track(folder, {"rmse_speed/policy": 0.5})
    tracking = RunList()
    assert tracking.is_run_id(run_id)
    assert tracking.folder_of_run(run_id) == folder
    (job,) = tracking.jobs_of_run(run_id)
    assert job.folder == folder
    assert '"rmse_speed/policy": 0.5' in (folder.parent / FILE).read_text()


def test_a_job_that_starts_again_goes_on_in_its_run(folder):
    def broken_off():
        config = SimpleNamespace(tracking=SimpleNamespace(uri=None))
        with RunList().run(config, folder) as tracker:
            run_ids.append(tracker.run_id)
            raise KeyboardInterrupt

    run_ids = []
    with pytest.raises(KeyboardInterrupt):
        broken_off()
    (job,) = RunList().jobs_of_run(run_ids[0])
    assert job.folder is None
    assert job.reason == "it is failed"
    assert track(folder, {}) == run_ids[0]
    (job,) = RunList().jobs_of_run(run_ids[0])
    assert job.folder == folder


def test_what_cannot_be_read_or_written_is_one_sentence(folder):
    with pytest.raises(TrackingError, match="is no list of runs"):
        RunList().folder_of_run("run_list-1")
    with pytest.raises(TrackingError, match="cannot be written"):
        track(folder, {}, uri=str(folder))
    track(folder, {})
    with pytest.raises(TrackingError, match="has no run"):
        RunList().folder_of_run("run_list-1")
