"""What README, CONTRIBUTING and docs/ print works as printed."""

from __future__ import annotations

import importlib
import json
import pkgutil
import re
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
import yaml

import cfx
from cfx.app.hydra_source import composed
from cfx.core import registry
from cfx.data.tidy import write_tidy
from cfx.simulation.synthetic import SyntheticDataset
from cfx_contracts import contract_for
from tests.checkout import ROOT, module_of, require_distributions
from tests.printed import Reader, all_blocks, blocks
from tests.test_imports import FLOORS

require_distributions()

COMMANDS = registry.names("command")
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))
DOCUMENTS = ["README.md", "CONTRIBUTING.md", *PAGES]
GUIDES = {"docs/plugins.md", "docs/how-to/own-model.md"}
"""Their commands need packages that they write before."""
NOT_IN_SEARCH = "---\nsearch:\n  exclude: true\n---\n\n"
"""What a page begins with that the site's search leaves out."""


def printed(language: str) -> Iterator[str]:
    """Yields the lines of all blocks of a language, comments cut off."""
    for name in DOCUMENTS:
        if name in GUIDES:
            continue
        for block in blocks(name, language):
            for line in block.splitlines():
                yield line.partition("  # ")[0].rstrip()


def commands() -> list[str]:
    """Returns the jobs that documents print, each once; sub-commands are not among them."""
    found = []
    for line in (*printed(""), *printed("sh")):
        words = line.split()
        if line.startswith("python -m cfx ") and words[3] not in (*COMMANDS, "--help"):
            found.append(line)
    return sorted(set(found))


def of_sub_commands() -> list[str]:
    """Returns the calls of sub-commands that documents print, in guides too, each once."""
    found = set()
    for name in DOCUMENTS:
        for language, block in all_blocks(name):
            if language not in {"", "sh", "text"}:
                continue
            for line in block.splitlines():
                call = line.partition("  # ")[0].strip()
                words = call.split()
                if words[:3] == ["python", "-m", "cfx"] and words[3:] and words[3] in COMMANDS:
                    found.add(call)
    return sorted(found)


def measured() -> list[str]:
    """Returns the commands of results.json; one of those whose first words are alike."""
    jobs = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
    found = {}
    for job in jobs.values():
        found[tuple(job["command"].split()[:5])] = job["command"]
    return list(found.values())


def nav_of(entries: Iterable[object]) -> Iterator[str]:
    """Yields the pages that a list of mkdocs.yml's navigation names."""
    for entry in entries:
        page = entry
        if isinstance(entry, dict):
            (page,) = entry.values()
        if isinstance(page, list):
            yield from nav_of(page)
        else:
            yield str(page)


def test_there_are_commands_to_check() -> None:
    assert len(commands()) >= 40
    first = set()
    for entry in registry.entries("command"):
        if entry.distribution != "cfx-example":  # whose README says how to call it
            first.add(entry.name.partition(".")[0])
    assert {call.split()[3] for call in of_sub_commands()} == first


@pytest.mark.parametrize(("name", "words"), [("README.md", 900), ("CONTRIBUTING.md", 800)])
def test_what_is_read_first_is_short(name: str, words: int) -> None:
    assert len((ROOT / name).read_text(encoding="utf-8").split()) <= words


def test_the_site_names_pages_that_exist() -> None:
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    pages = list(nav_of(nav))
    assert len(set(pages)) == len(pages) > 30
    assert not [page for page in pages if not (ROOT / "docs" / page).is_file()]
    for name in PAGES:
        page = name.removeprefix("docs/")
        is_record = page.startswith("decisions/0")  # the index of decisions names them
        assert page in pages or is_record, f"{name} is in no menu of mkdocs.yml"


def test_the_page_of_the_door_is_made_from_it() -> None:
    door = module_of(ROOT / "docs" / "door.py")
    page = door.text()
    assert door.PAGE.read_text(encoding="utf-8") == page, "make conf"
    assert not re.findall(r"^\| `(\w+)` \|\s+\|$", page, flags=re.MULTILINE), "no meaning"
    assert "ndarray(shape" not in page  # a constant is not documented by the class of its value


def test_every_public_name_is_in_the_reference() -> None:
    text = ""
    for path in sorted((ROOT / "docs" / "api").glob("*.md")):
        text += path.read_text(encoding="utf-8")
    known = set(re.findall(r"^::: (\S+)$", text, flags=re.MULTILINE))
    names = {f"cfx.{name}" for name in cfx.__all__} - {"cfx.__version__", "cfx.plugin"}
    assert known >= names
    for name in known:
        assert pkgutil.resolve_name(name) is not None


def test_every_option_is_in_the_table_of_all_options() -> None:
    text = (ROOT / "docs" / "choose.md").read_text(encoding="utf-8")
    section = text.partition("## All options\n")[2]
    for group in (*registry.GROUPS, "experiment"):
        (row,) = re.findall(rf"^\| `{group}` \| (.*) \|$", section, flags=re.MULTILINE)
        folder = ROOT / "conf" / group
        for path in folder.glob("*.yaml"):
            assert f"`{path.stem}`" in row, f"{group}={path.stem}"


def test_the_list_of_how_tos_is_the_one_of_the_site() -> None:
    folder = ROOT / "docs" / "how-to"
    index = (folder / "index.md").read_text(encoding="utf-8")
    for path in sorted(folder.glob("*.md")):
        if path.name == "index.md":
            continue
        title = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        assert title.endswith("?")
        assert f"[{title}]({path.name})" in index


def anchors(text: str) -> set[str]:
    """Returns what links may point to within a document: its headings, as GitHub writes them."""
    found = set()
    for heading in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE):
        letters = re.sub(r"[^\w\- ]", "", heading.lower())
        found.add(letters.replace(" ", "-"))
    return found


@pytest.mark.parametrize("name", [*DOCUMENTS, "docs/llms.txt"])
def test_links_lead_somewhere(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    wrong = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = (ROOT / name).parent / file if file else ROOT / name
        if not target.exists() or (anchor and anchor not in anchors(target.read_text("utf-8"))):
            wrong.append(link)
    assert not wrong


def test_every_decision_is_in_the_index_and_has_its_three_parts() -> None:
    folder = ROOT / "docs" / "decisions"
    index = (folder / "README.md").read_text(encoding="utf-8")
    records = sorted(folder.glob("[0-9]*.md"))
    assert len(records) <= 25, "what concerns one place is a comment there"
    assert index.startswith(NOT_IN_SEARCH)
    for number, path in enumerate(records, start=1):
        assert path.name.startswith(f"{number:04d}-")
        assert f"]({path.name})" in index
        text = path.read_text(encoding="utf-8")
        assert text.startswith(f"{NOT_IN_SEARCH}# {number}. ")
        for part in ("Context", "Decision", "Consequence"):
            assert f"\n**{part}.** " in text, f"{path.name}: {part}"


@pytest.mark.parametrize("command", [*commands(), *measured()])
def test_the_documents_commands_compose(command: str) -> None:
    overrides = []
    for word in shlex.split(command)[3:]:
        if word.startswith(("hydra/sweeper=", "hydra.sweeper.")):
            continue  # Optuna's is no dependency: where it is not installed Hydra knows no such option
        if re.match(r"\+{0,2}[\w./]+=[^\[{]*,", word):  # a sweep: its first value
            overrides.append(word.partition(",")[0].replace("range(", ""))
        elif word != "-m":
            overrides.append(word)
    assert composed(overrides)


@pytest.mark.parametrize("call", of_sub_commands())
def test_the_documents_sub_commands_have_these_options(call: str) -> None:
    name, *arguments = shlex.split(call)[3:]
    if arguments and f"{name}.{arguments[0]}" in registry.names("command"):
        name, arguments = f"{name}.{arguments[0]}", arguments[1:]
    command = cfx.get("command", name)()
    assert isinstance(command, cfx.plugin.Command)
    command.parse(arguments)


def test_the_readmes_python_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_tidy(SyntheticDataset(pairs=2, frames=720).load(), "pairs.csv")
    (block,) = blocks("README.md", "python")
    names: dict[str, object] = {}
    exec(block, names)  # noqa: S102 - it is our own README
    fit, result = names["fit"], names["result"]
    assert isinstance(fit, cfx.Fit)
    assert isinstance(result, cfx.plugin.Result)
    assert "ci95_low" in capsys.readouterr().out
    (command,) = [one for one in commands() if one.endswith("data=tidy data.path=pairs.csv")]
    printed_config = cfx.config(**dict(word.split("=", 1) for word in shlex.split(command)[3:]))
    assert printed_config.command == fit.command.replace(f"{tmp_path}/", "")


def test_the_guides_python_is_the_examples() -> None:
    shown = blocks("docs/plugins.md", "python")
    assert len(shown) >= 4
    for block in shown:
        head, _, text = block.partition("\n")
        path = ROOT / head.removeprefix("# ")
        assert path.is_relative_to(ROOT / "plugins" / "cfx-example"), head
        assert path.read_text(encoding="utf-8") == text, f"copy {head} into docs/plugins.md"


def test_the_rival_in_the_guide_is_the_example() -> None:
    example = blocks("docs/benchmark.md", "python")[0]
    head, _, text = example.partition("\n")
    path = ROOT / head.removeprefix("# ")
    assert path.read_text(encoding="utf-8") == text, f"copy {head} into docs/benchmark.md"


def test_the_table_of_kinds_names_what_is_there() -> None:
    text = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    row = r"^\| (\w+) \| `cfx\.plugin\.(\w+)` \| .* \| (?:`(cfx_contracts\.\w+)`|none) \|$"
    rows = re.findall(row, text, flags=re.MULTILINE)
    assert {kind for kind, _, _ in rows} == set(registry.every_kind()) - {"section", "rival"}
    for kind, base, module in rows:
        cls = getattr(cfx.plugin, base)
        assert f"{cls.__module__}:{base}" == registry.kind_of(kind).base
        assert bool(module) == (kind in registry.KINDS)
        if module:
            assert importlib.import_module(module).CONTRACT is contract_for(kind)
    assert f"`cfx.plugin.API_VERSION` ({cfx.plugin.API_VERSION})" in text
    (declared,) = re.findall(
        r'^\[project\.entry-points\."cfx\.api"\]\n(\d+) = ', text, flags=re.MULTILINE
    )
    assert int(declared) == cfx.plugin.API_VERSION


def test_the_map_has_every_room_on_the_floor_that_the_test_of_imports_has() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    area = text.partition("\ncfx/\n")[2].partition("\nconf/ ")[0]
    mapped: dict[int, list[str]] = {}
    for line in area.splitlines():
        row = re.fullmatch(r" +(\d+) {2}((\w+)(?:/|\.pyi?)) +\S.*", line)
        assert row is not None, line
        height, path, room = row.groups()
        assert (ROOT / "cfx" / path).exists(), f"{path} is not there any more"
        mapped.setdefault(int(height), []).append(room)
    assert list(mapped) == sorted(mapped, reverse=True)
    assert mapped == {height: list(floor) for height, floor in enumerate(FLOORS, start=1)}
    for path in (ROOT / "cfx").iterdir():
        if path.is_dir() and path.name not in {"__pycache__", "conf"}:
            assert f"  {path.name}/ " in area, path.name
        elif path.suffix == ".py" and not path.name.startswith("__"):
            assert path.name in area, path.name


@pytest.mark.parametrize(
    "path", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda path: path.stem
)
def test_the_forms_of_issues_are_complete(path: Path) -> None:
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= set(form)
    names = [part["id"] for part in form["body"]]
    assert len(set(names)) == len(names)
    for part in form["body"]:
        assert part["type"] in {"input", "textarea", "dropdown"}
        assert {"label", "description"} <= set(part["attributes"])
        assert ("options" in part["attributes"]) == (part["type"] == "dropdown")


def guide() -> list[str]:
    """Returns the shell's blocks of the guide by which a plugin comes about, in order."""
    text = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    section = text.partition("## Writing a plugin\n")[2].partition("\n### Components")[0]
    return re.findall(r"^```sh\n(.*?)^```$", section, flags=re.DOTALL | re.MULTILINE)


def test_the_guide_names_what_the_door_has() -> None:
    text = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    names = set(re.findall(r"\bcfx\.plugin\.(\w+)", text))
    assert len(names) > 20
    assert names <= set(cfx.plugin.__all__)
    groups = {kind.entry_points for kind in registry.every_kind().values()}
    groups |= {registry.API_GROUP, registry.KINDS_GROUP}
    doors = {"cfx.plugin", "cfx.errors", "cfx.get", "cfx.sklearn"}
    assert set(re.findall(r"\bcfx\.[a-z]+\b", text)) <= groups | doors


def test_the_table_of_simple_kinds_names_what_is_there() -> None:
    text = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\w+) \| `(cfx\.\w+)` \| `([\w.]+)` \|", text, flags=re.MULTILINE)
    kinds = registry.every_kind()
    assert {part for part, _, _ in rows} == set(kinds) - set(registry.KINDS)
    for part, group, base in rows:
        assert kinds[part].entry_points == group
        assert pkgutil.resolve_name(base) is pkgutil.resolve_name(kinds[part].base)


@pytest.mark.slow
def test_the_guide_to_a_plugin_works_as_printed(tmp_path: Path) -> None:
    reader = Reader(tmp_path)
    for block in guide():
        reader.shell(block)
    report = (tmp_path / "outputs" / "mine" / "report.html").read_text(encoding="utf-8")
    assert "mine" in report
