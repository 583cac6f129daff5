"""Citations of pages in the code and links between pages resolve, and the prose of docs/ stays short.

The code cites a page by its path from the root, with the anchor of a heading where it means one:
docs/reference/protocol.md#blocking-times. Pages link to each other with relative links.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from statistics import mean
from typing import Final

import pytest

ROOT: Final = Path(__file__).parent.parent
PACKAGES: Final = ("gateway", "fleet", "schemas", "tests", "deploy")
PAGES: Final = tuple(sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "fleet").rglob("*.md")]))
DOCS: Final = tuple(page for page in PAGES if page.is_relative_to(ROOT / "docs"))
TEXT_SUFFIXES: Final = frozenset({".py", ".proto", ".yaml", ".toml", ".service", ".rules", ".tsv", ".ipynb", ".sh"})

CITATION: Final = re.compile(r"(?<![\w./-])((?:[\w.-]+/)*[\w-]+\.md)\b(?:#([\w-]+))?")
LINK: Final = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
CODE_PATH: Final = re.compile(r"`((?:gateway|fleet|schemas|tests|deploy)/[\w./-]+\.\w+)`")
FENCE: Final = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)

MEAN_WORDS: Final = 18
MAX_WORDS: Final = 32


def prose(page: Path) -> str:
    """Return the text of a page without its code blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
        same = sum(each == slug or re.fullmatch(rf"{re.escape(slug)}-\d+", each) is not None for each in found)
        found.add(f"{slug}-{same}" if same else slug)
    return found


def fault(target: Path, anchor: str) -> str:
    """Return why a page or its heading is not there; empty if both are."""
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
    """Return the citations in a text that lead nowhere."""
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
        if re.match(r"[a-z]+:", path):
            continue
        if why := fault((page.parent / path).resolve() if path else page, anchor):
            faults.append(f"{link}: {why}")
    if page in DOCS:
        faults += [f"no file {path}" for path in CODE_PATH.findall(text) if not (ROOT / path).exists()]
    assert not faults, "\n".join(faults)


def sentences(page: Path) -> list[str]:
    """Return the sentences of a page, without tables, headings and the targets of links."""
    lines = [line for line in prose(page).splitlines() if not line.startswith(("|", "#", "<!--"))]
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", "\n".join(lines))
    paragraphs = re.split(r"\n\s*\n|^\s*- ", text, flags=re.MULTILINE)
    split = (each for paragraph in paragraphs for each in re.split(r"(?<=[.!?])\s+", " ".join(paragraph.split())))
    return [each for each in split if each]


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.stem)
def test_sentences_are_short(page: Path) -> None:
    lengths = {each: len(each.split()) for each in sentences(page)}
    assert not [each for each, words in lengths.items() if words > MAX_WORDS]
    assert mean(lengths.values()) <= MEAN_WORDS


def test_a_page_or_a_heading_that_is_not_there_is_found() -> None:
    gone = "docs/reference/nothing" + ".md"
    assert faults_of(f"# see {gone}", "x") == [f"x: {gone}: no file {gone}"]
    assert faults_of("(docs/reference/protocol.md" + "#nothing)", "x")[0].endswith("has no heading #nothing")
    assert faults_of("# protocol" + ".md, framing", "x"), "a citation without the path"
    assert not faults_of("(docs/reference/protocol.md#framing).", "x")
