"""Publishing: a finished job becomes a ready-made policy with a card."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cfx.errors import ConfigError
from cfx.policies.checkpoint import load_agent, save_agent
from cfx.policies.ready import READY_FOLDER, card_of, names
from cfx.policies.ready.traffic_table import traffic_of
from cfx_report.benchmark import publish
from cfx_report.benchmark.publish import card_text, make
from cfx_report.benchmark.recipes import RECIPES


def test_there_is_a_recipe_for_each_policy() -> None:
    assert set(names()) == set(RECIPES)


def test_a_finished_job_is_published_without_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = names()[0]
    job, folder = tmp_path / "work" / name, tmp_path / "ready"
    published = READY_FOLDER / name
    agent = load_agent(published / "policy")
    save_agent(agent, job / "policy")
    metrics = json.loads((published / "metrics.json").read_text())
    on_card = card_of(name)["errors_on_unseen_drivers"]
    low, high = on_card["improvement_over_pooled_ci95"]
    pooled = "full_trajectory/improvement/rmse_speed/pooled"
    metrics |= {f"{pooled}/ci95_low": low, f"{pooled}/ci95_high": high}
    metrics[f"{pooled}/geometric"] = on_card["improvement_over_pooled"]
    metrics["improvement/rmse_speed/driver_specific/geometric"] = on_card[
        "last_part_improvement_over_own"
    ]
    (job / "metrics.json").write_text(json.dumps(metrics))
    (job / "data.json").write_text(json.dumps({"fingerprint": "abc"}))
    learner = "learner:\n  simulated_drivers: 80\n  simulated_queues: 0\n"
    (job / "config.yaml").write_text(learner)
    monkeypatch.setattr(publish, "READY_FOLDER", folder)
    stress = card_of(name)["stress"]
    monkeypatch.setattr(publish, "_stress", lambda _: stress)
    measured = traffic_of(name)
    monkeypatch.setattr(publish, "_traffic", lambda *_: measured)
    make([name], tmp_path / "not-needed.parquet", tmp_path / "work")
    card = json.loads((folder / name / "card.json").read_text())
    expected = card_of(name)
    for key in ("model", "errors_on_unseen_drivers", "safety", "valid_range", "command"):
        assert card[key] == expected[key]
    text = (folder / name / "CARD.md").read_text()
    assert text == card_text(card, measured)
    assert "too: 80 in stop-and-go traffic (Krauss's model and IDM)\n" in text
    assert traffic_of(name) == json.loads((folder / name / "traffic.json").read_text())


def test_an_unknown_recipe_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"there is no such recipe\. Did you mean 'idm'"):
        make(["idn"], tmp_path / "data.parquet", tmp_path)
