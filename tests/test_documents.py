"""What the README and the architecture page name is there, and the README's table of experiments is the present one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dsfit.figures.catalogue import find, names
from dsfit.figures.listing import markdown_rows

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {"README.md": README, "dsfit/ARCHITECTURE.md": (ROOT / "dsfit/ARCHITECTURE.md").read_text(encoding="utf-8")}


def test_the_table_of_experiments_is_what_the_command_prints() -> None:
    stored = README.split("<!-- experiments -->")[1].split("<!-- /experiments -->")[0].strip()
    assert stored == markdown_rows([find(ROOT, name) for name in names(ROOT)])


@pytest.mark.parametrize("page", PAGES)
def test_named_files_exist(page: str) -> None:
    named = set(
        re.findall(r"(?<![\w/.-])((?:configs|experiments|tests|dsfit)/[\w/.-]+\.(?:toml|py|exr|md))", PAGES[page])
    )
    base = ROOT / "dsfit" if page.startswith("dsfit/") else ROOT
    missing = [name for name in named if not (ROOT / name).exists() and not (base / name).exists()]
    assert not [name for name in missing if "NAME" not in name]


@pytest.mark.parametrize("page", PAGES)
def test_experiments_and_configs_named_in_commands_exist(page: str) -> None:
    known = {*names(ROOT), "NAME", "FILE"}
    commands = re.findall(r"dsfit figures (?:run|draw|verify) ((?!runs/)[a-z_0-9]+)", PAGES[page])
    assert set(commands) <= known
    assert {
        Path(name).name
        for name in re.findall(r"dsfit (?:run|check|bench|render|sweep|plan) (configs/\S+?\.toml)", README)
    } <= {path.name for path in (ROOT / "configs").glob("*.toml")}


@pytest.mark.parametrize("heading", re.findall(r"\]\(#([\w-]+)\)", README))
def test_links_within_the_readme_lead_somewhere(heading: str) -> None:
    headings = [
        re.sub(r"[^\w -]", "", line.lstrip("# ").lower()).replace(" ", "-")
        for line in README.splitlines()
        if line.startswith("#")
    ]
    assert heading in headings
