"""Tests that citations in the code, links between pages and the navigation resolve, and that sentences are short.

The code cites a page by its path from the root, with the anchor of a heading if it cites a section:
docs/reference/protocol.md#blocking-times. Pages of docs/ link to each other with relative links, and to other files of
the repository with the address of its `main`. README.md has addresses only: package indexes show it, too.
"""

import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

import pytest

from tests.tools.site import CONFIGURATION, FROM_TOP

ROOT: Final = Path(__file__).parent.parent
PACKAGES: Final = ("gateway", "fleet", "schemas", "tests", "deploy")
PAGES: Final = tuple(sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / ".github").rglob("*.md")]))
README: Final = ROOT / "README.md"
CLI: Final = ROOT / "docs/reference/cli"
CLI_INDEX: Final = ROOT / "docs/reference/cli/index.md"
REPOSITORY: Final = re.compile(
    r"https://(?:github\.com/zenoh-car-fleet/zenoh-car-fleet/(?:blob|tree)|raw\.githubusercontent\.com/zenoh-car-fleet/zenoh-car-fleet)/main/(.+)"
)
DOCS: Final = tuple(page for page in PAGES if page.is_relative_to(ROOT / "docs"))
TEXT_SUFFIXES: Final = frozenset({".py", ".proto", ".yaml", ".toml", ".service", ".rules", ".tsv", ".ipynb", ".sh"})
CITATION: Final = re.compile(r"(?<![\w./-])((?:[\w.-]+/)*[\w-]+\.md)\b(?:#([\w-]+))?")
LINK: Final = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
CODE_PATH: Final = re.compile(r"`((?:gateway|fleet|schemas|tests|deploy)/[\w./-]+\.\w+)`")
FENCE: Final = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)

README_LINES: Final = 200
INTERNAL: Final = ("hub", "token", "consolidation", "lease", "protobuf", "liveliness", "frame", "chunk")


@cache
def prose(page: Path) -> str:
    """Return the text of a page without its code blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


@cache
def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
        same = sum(each == slug or re.fullmatch(rf"{re.escape(slug)}-\d+", each) is not None for each in found)
        found.add(f"{slug}-{same}" if same else slug)
    return found


def fault(target: Path, anchor: str) -> str:
    """Return an error if the page or its heading does not exist, else an empty text."""
    if not target.exists():
        return f"no file {target.relative_to(ROOT) if target.is_relative_to(ROOT) else target}"
    if anchor and anchor not in anchors(target):
        return f"{target.name} has no heading #{anchor}"
    return ""


def code_files() -> Iterator[Path]:
    """Yield every text file that may cite a page."""
    yield from (ROOT / "Makefile", ROOT / "pyproject.toml")
    for package in PACKAGES:
        yield from (each for each in sorted((ROOT / package).rglob("*")) if each.suffix in TEXT_SUFFIXES)


def faults_of(text: str, where: str) -> list[str]:
    """Return the citations in a text that do not resolve."""
    cited = [(match[1], match[2] or "") for match in CITATION.finditer(text)]
    return [f"{where}: {path}: {why}" for path, anchor in cited if (why := fault(ROOT / path, anchor))]


def test_each_citation_in_the_code_resolves() -> None:
    faults: list[str] = []
    cited = 0
    for file in code_files():
        text = file.read_text(encoding="utf-8")
        cited += text.count("docs/reference/protocol.md")
        faults += faults_of(text, str(file.relative_to(ROOT)))
    assert not faults, "\n".join(["cite a page by its path from the root, on one line:", *faults])
    assert cited > 80, "the search finds no citations any more"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_each_link_and_path_on_a_page_resolves(page: Path) -> None:
    text = prose(page)
    faults = faults_of(LINK.sub("", text), page.name)
    for link in LINK.findall(text):
        path, _, anchor = link.partition("#")
        if ours := REPOSITORY.fullmatch(path):
            target = ROOT / ours[1]
        elif re.match(r"[a-z]+:", path):
            continue
        else:
            target = (page.parent / path).resolve() if path else page
        if page in DOCS and not ours and not target.is_relative_to(ROOT / "docs"):
            faults.append(f"{link}: leads out of docs/, where the site ends")
        elif why := fault(target, anchor):
            faults.append(f"{link}: {why}")
    if page in DOCS:
        faults += [f"no file {path}" for path in CODE_PATH.findall(text) if not (ROOT / path).exists()]
    assert not faults, "\n".join(faults)


def navigation(part: Any) -> Iterator[str]:
    """Yield the pages of the navigation, at any depth."""
    for entry in part:
        for below in entry.values():
            yield from (below,) if isinstance(below, str) else navigation(below)


def test_navigation_is_complete() -> None:
    """Every page is in the navigation once. The pages of commands have an index of their own."""
    with (ROOT / "docs" / CONFIGURATION).open("rb") as file:
        found = Counter(navigation(tomllib.load(file)["project"]["nav"]))
    index = (CLI_INDEX).read_text(encoding="utf-8")
    listed = {str(page.relative_to(ROOT / "docs")) for page in CLI.glob("*.md") if f"]({page.name})" in index}
    assert {page for page, times in found.items() if times > 1} == set()
    assert {str(page.relative_to(ROOT / "docs")) for page in DOCS} | set(FROM_TOP.values()) == set(found) | listed


def test_docs_holds_only_what_is_published() -> None:
    texts = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    for path in sorted((ROOT / "docs").rglob("*")):
        if path.is_file() and path.suffix != ".md" and path.name != CONFIGURATION:
            assert path.parent.name == "pictures", path
            assert f"pictures/{path.name}" in texts, f"{path.name} is shown nowhere"


GLOSSARY: Final = ROOT / "docs/reference/glossary.md"
PRODUCTS: Final = re.compile(r"(?i)WAVE ROVER|UGV Rover|boot\.mission|`\+mission`|rover:ugv_rover")
"""Names that their maker gave."""
BRITISH: Final = re.compile(r"(?i)\b(?:colour\w*|metres?|behaviour|neighbour\w*|grey|licence)\b")


@pytest.mark.parametrize("page", [README, *DOCS], ids=lambda page: str(page.relative_to(ROOT)))
def test_words_are_plain(page: Path) -> None:
    """No page has a synonym of a word of the glossary, or British spelling."""
    glossary = GLOSSARY.read_text(encoding="utf-8")
    rows = re.findall(r"^\| [^|]+ \| [^|]+ \| ([^|]+?) ?\|$", glossary, re.MULTILINE)
    refused = {word.strip() for row in rows for word in row.split(",")} - {"", "instead of"}
    assert "kill switch" in refused
    text = PRODUCTS.sub("", prose(page)) if page != GLOSSARY else ""
    faults = [word for word in refused if re.search(rf"\b{re.escape(word)}s?\b", text, re.IGNORECASE)]
    faults += BRITISH.findall(text)
    assert faults == []


# The README.


def test_readme_is_short_and_its_links_work_anywhere() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= README_LINES
    links = LINK.findall(FENCE.sub("", text)) + re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", text))
    assert [link for link in links if not link.startswith(("https://", "#"))] == []
    assert "<!--" not in text, "a generated part"
    for target in ("make demo", "make test"):
        assert text.index(target) < text.index("## Drive your own car")


def test_readme_has_no_internals_above_how_it_works() -> None:
    above = README.read_text(encoding="utf-8").partition("## How it works")[0]
    assert re.findall(rf"(?i)\b(?:{'|'.join(INTERNAL)})s?\b", above) == []


def test_broken_page_or_heading_link_is_found() -> None:
    gone = "docs/reference/nothing" + ".md"
    assert faults_of(f"# see {gone}", "x") == [f"x: {gone}: no file {gone}"]
    assert faults_of("(docs/reference/protocol.md" + "#nothing)", "x")[0].endswith("has no heading #nothing")
    assert faults_of("# protocol" + ".md, framing", "x"), "a citation without the path"
    assert not faults_of("(docs/reference/protocol.md#framing).", "x")


def test_changelog_says_nothing_twice() -> None:
    """Each heading and each line of a version stands once: two branches that were merged left a block twice."""
    lines = Counter(line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line)
    assert [line for line, count in lines.items() if count > 1] == []
