"""Ready-made policies: complete, safe to read, and usable wherever a job is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

import cfx
from cfx.app import cli
from cfx.app.job.steps import JobComponents, complete, make_protocol
from cfx.errors import DataError
from cfx.policies import checkpoint, ready
from cfx.policies.ready.traffic_table import outside_words, traffic_lines, traffic_of
from tests.histories import observed

NAMES = ready.names()


@pytest.mark.parametrize("name", NAMES)
def test_each_is_small_and_holds_no_code_and_no_recording(name: str) -> None:
    folder = ready.folder_of_ready_made(f"cfx://{name}")
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert files == {
        "card.json",
        "CARD.md",
        "metrics.json",
        "traffic.json",
        "policy/policy.json",
        "policy/policy.safetensors",
    }
    assert sum((folder / file).stat().st_size for file in files) < 600_000


@pytest.mark.parametrize("name", NAMES)
def test_each_drives_an_unseen_driver(name: str) -> None:
    agent = cfx.load(f"cfx://{name}").policy
    assert agent.names == ("all",) or len(agent.names) == 1
    assert agent.valid_range is not None
    assert agent.trained_on.quantiles
    frames = torch.full((1, agent.windows.length), 10.0, dtype=torch.float64)
    history = observed(frames, frames * 0, frames, frames * 0, frames * 2)
    chosen, state = agent.act(history, agent.begin(torch.zeros(1, dtype=torch.int64)))
    low, high = agent.space.bounds()
    assert bool(((chosen >= low - 1e-9) & (chosen <= high + 1e-9)).all())
    assert float(state.score[0]) < 1.0


@pytest.mark.parametrize("name", NAMES)
def test_each_card_says_what_a_user_must_know(name: str) -> None:
    card = ready.card_of(name)
    assert card["errors_on_unseen_drivers"]["rmse_speed"] < 0.9
    assert card["errors_on_unseen_drivers"]["improvement_over_pooled"] > 0
    # Full trajectories of unseen drivers, which have no guard as SUMO's step has.
    assert card["safety"]["collisions"] == 0
    # Krauss's acceleration jumps from step to step, and more so on fast roads; its card says so.
    assert card["safety"]["jerk"] < (2.0 if name == "krauss" else 1.5)
    kinds = {event["kind"]: event for event in card["stress"]["events"]}
    assert kinds["cut-ins"]["number"] >= 1000
    assert kinds["cut-ins"]["headway"][0] < 0.1
    for event in kinds.values():
        assert event["collisions"] == 0
        assert event["hardest_braking"] <= 9.0 + 1e-6
        assert event["hardest_acceleration"] <= 2.6 + 1e-6
    text = (ready.READY_FOLDER / name / "CARD.md").read_text(encoding="utf-8")
    assert card["command"] in text
    for row in card["sites"]:
        assert row["site"] in text
    assert "CC BY 4.0" in text
    assert "Valid range" in text


@pytest.mark.parametrize("name", NAMES)
def test_each_card_has_a_table_of_traffic(name: str) -> None:
    """It was measured as its command says."""
    measured = traffic_of(name)
    assert measured is not None
    text = (ready.READY_FOLDER / name / "CARD.md").read_text(encoding="utf-8")
    for line in traffic_lines(measured):
        assert line in text
    assert f"cfx drive stress --drivers car=cfx://{name}" in measured["command"]
    kinds = {row["measure"] for row in measured["rows"]}
    assert kinds >= {"capacity", "saturation_flow", "discharge", "town_throughput", "dip_last"}
    knows_drivers = cfx.load(f"cfx://{name}").policy.trained_on.drivers is not None
    assert bool(measured["time_gaps"]) == knows_drivers


def test_stochastic_drivers_vary_with_the_seed_and_are_calibrated() -> None:
    name = "idm-stochastic"
    agent = cfx.load(f"cfx://{name}").policy
    assert agent.core.head.is_stochastic
    frames = torch.full((2, agent.windows.length), 10.0, dtype=torch.float64)
    history = observed(frames, frames * 0, frames, frames * 0, frames * 2)

    def chosen(seed: int | None) -> torch.Tensor:
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        state = agent.begin(torch.zeros(2, dtype=torch.int64))
        return agent.act(history, state, generator)[0]

    assert torch.equal(chosen(1), chosen(1))
    assert not torch.equal(chosen(1), chosen(2))
    assert not torch.equal(chosen(1)[0], chosen(1)[1])
    centre = chosen(None)
    state = agent.begin(torch.zeros(2, dtype=torch.int64))
    assert not agent.act(history, state)[1].latent.any(), "nothing is drawn"
    # Equal rows of a matrix product may differ in their last bits.
    torch.testing.assert_close(centre[0], centre[1], rtol=1e-6, atol=1e-9)
    rows = ready.card_of(name)["distributions"]
    assert [row["horizon_s"] for row in rows] == [0.5, 1.0, 2.0, 3.0, 5.0, 10.0]
    for row in rows:
        # Of drivers of roads that it does not know fewer are within the central 90 %, least at 10 s.
        assert 0.65 <= row["coverage"] <= 0.95
    text = (ready.READY_FOLDER / name / "CARD.md").read_text(encoding="utf-8")
    assert "Sampled forecasts" in text
    assert "residual_scale" not in text


def test_what_was_loaded_is_shown_in_two_lines() -> None:
    lines = repr(cfx.load("cfx://idm")).splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("Result(model=idm, policy=gru, ")
    error = ready.card_of("idm")["errors_on_unseen_drivers"]["last_part_rmse_speed"]
    assert f"RMSE of speed {error:.3f} m/s" in lines[0]
    assert lines[1].strip().startswith("folder=")


def test_an_unknown_one_is_one_sentence() -> None:
    with pytest.raises(DataError, match=r"there is no ready-made policy 'idn'\. Did you mean"):
        cfx.load("cfx://idn")


def test_the_command_lists_and_shows_them(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["policies"], ["policies", "list"]):
        assert cli.main(words) == 0
        listed = capsys.readouterr().out
        for name in NAMES:
            assert f"cfx://{name}" in listed
    assert cli.main(["policies", "show", NAMES[0]]) == 0
    card = capsys.readouterr().out
    assert card.startswith(f"# {NAMES[0]}")
    assert cli.main(["policies", "show", f"cfx://{NAMES[0]}"]) == 0
    assert capsys.readouterr().out == card
    assert cli.main(["policies", "show", "nobody"]) == 2


def test_transfer_takes_one_by_its_name() -> None:
    from cfx.results.config import JobConfig

    node = {"name": "transfer", "run": f"cfx://{NAMES[0]}"}
    config = JobConfig.of(
        {
            "data": {"name": "synthetic"},
            "model": {"name": "idm"},
            "policy": {"name": "gru"},
            "optimizer": {"name": "random"},
            "learner": {"name": "rollout"},
            "protocol": node,
        }
    )
    determined = make_protocol(config).determines()
    assert determined["model"]["name"] == ready.card_of(NAMES[0])["model"]


def test_a_policy_that_answers_what_its_model_does_not_use_is_tested_all_the_same() -> None:
    from cfx.results.config import JobConfig

    node = {"name": "transfer", "run": "cfx://w99"}
    config = JobConfig.of(
        {
            "data": {"name": "synthetic"},
            "model": {"name": "w99"},
            "policy": {"name": "fixed"},
            "optimizer": {"name": "random"},
            "learner": {"name": "rollout"},
            "protocol": node,
        }
    )
    protocol = make_protocol(config)
    model = JobComponents.of(complete(config, protocol), protocol).model
    assert model.space.names == cfx.load("cfx://w99").policy.core.head.model_space.names


def test_a_policy_that_is_too_large_or_no_object_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = checkpoint.load_agent(ready.READY_FOLDER / NAMES[0] / "policy")
    checkpoint.save_agent(agent, tmp_path)
    monkeypatch.setattr("cfx.core.job_folder._LARGEST_MB", 0.2)
    with pytest.raises(DataError, match=r"policy\.safetensors has 0 MB, at most 0\.2"):
        checkpoint.load_agent(tmp_path)
    monkeypatch.undo()
    (tmp_path / "policy.json").write_text(json.dumps([1, 2]))
    with pytest.raises(DataError, match="is no JSON object"):
        checkpoint.load_agent(tmp_path)
    (tmp_path / "policy.safetensors").write_bytes(b"\xff" * 100)
    with pytest.raises(DataError, match="holds no policy that can be read"):
        checkpoint.load_agent(tmp_path)


def test_values_outside_of_what_is_usual_are_counted_among_those_with_usual_values() -> None:
    rows = [
        {"usual": "1 to 2", "outside": True},
        {"usual": "1 to 2", "outside": False},
        {"usual": "", "outside": False},
    ]
    assert outside_words({"rows": rows}) == (1, 2)
