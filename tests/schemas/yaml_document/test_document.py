"""YAML files of users: the reader reports all faults at once, with line and column, and rejects harmful input."""

import os
from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field

from schemas.yaml_document.document import MAX_YAML_BYTES, BadFile, Entry, read_text
from tests.support.text_parts import has_parts
from tests.support.yaml_text import read_yaml


class Wheel(Entry):
    size_m: float = Field(default=1.0, gt=0, le=10)
    spokes: int = Field(default=8, ge=1)


class Wagon(Entry):
    wheels: dict[str, Wheel] = Field(description="at least one wheel")
    mode: Literal["slow", "fast"] = "slow"
    flag: bool = False
    spare: Wheel | list[Wheel] | None = None
    names: list[str] = Field(default_factory=list)


def _faults(text: str) -> list[str]:
    with pytest.raises(BadFile) as caught:
        read_yaml(text, "f.yaml", Wagon)
    return str(caught.value).splitlines()


def test_all_faults_are_told_at_once_each_in_its_place() -> None:
    text = "wheels:\n  a: {size_m: 12, spokes: 1.5, rim: 3}\n  b: 3\nmode: fats\nflg: true\nnames: [x, 7]\n"
    assert _faults(text) == [
        "f.yaml:2:15: error: wheels.a.size_m: 12 is not allowed. Write a number, more than 0 and at most 10.",
        "f.yaml:2:27: error: wheels.a.spokes: 1.5 is not allowed. Write a whole number, at least 1.",
        "f.yaml:2:32: error: wheels.a.rim: there is no such field. There are size_m, spokes.",
        "f.yaml:3:6: error: wheels.b: needs fields. Write: `b: {size_m: …}`",
        "f.yaml:4:7: error: mode: 'fats' is not allowed. Did you mean fast?",
        "f.yaml:5:1: error: flg: there is no such field. Did you mean flag?",
        "f.yaml:6:12: error: name 2: 7 is not allowed. Write text in quotes.",
    ]


def test_yaml_is_that_of_1_2() -> None:
    wagon = read_yaml("wheels: {on: {}, no: {}}\nnames: [11:22:33:44:55:10, off, 1_000]", "f", Wagon)
    assert list(wagon.wheels) == ["on", "no"]
    assert wagon.names == ["11:22:33:44:55:10", "off", "1_000"]


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("", "1:1", "file is empty"),
        ("# nothing but words\n", "1:1", "file is empty"),
        ("wheels:\n\ta: 1", "2:1", "a tab"),
        ("wheels: {a: {}\n", "2:1", "not YAML"),
        ("- 1", "1:1", "a list … fields"),
        ("--- {}\n--- {}", "2:1", "a second document"),
        ("wheels: {}\nwheels: {}", "2:1", "wheels: … twice, … line 1"),
        ("wheels: {a: {spokes: 2, spokes: 3}}", "1:25", "wheels.a.spokes: is given twice"),
        ("mode: fast", "1:1", "wheels: is missing. … one wheel."),
        ("wheels:", "1:8", "wheels: … no value. … fields"),
        ("wheels: {1: {}}", "1:10", "key '1' … word"),
        ("wheels: {[a]: {}}", "1:10", "not a word"),
        ("wheels: {a: {size_m: .nan}}", "1:22", "finite number"),
        ("wheels: {a: {size_m: 1e999}}", "1:22", "finite number"),
        ("wheels: {a: {size_m: true}}", "1:22", "true … number"),
        ("wheels: {a: {spokes: '8'}}", "1:22", "'8' … whole number"),
        ("wheels: {a: {spokes: " + "9" * 5000 + "}}", "1:22", "too many digits"),
        ("wheels: {a: {spokes: " + "9" * 50 + "}}", "1:22", "too large"),
        ("wheels: !!python/object:os.system {a: {}}", "1:9", "the tag"),
        ("wheels: {}\nspare: #ff8000", "2:7", "a # … comment. … in quotes: '#ff8000'"),
        ("wheels: {a: {size_m: #ff8000}}\nmode: fast", "1:22", "in quotes: '#ff8000'"),
        ("wheels: {}\nnames: [#ff8000, #ff0000]", "2:9", "in quotes: '#ff8000'"),
        ("wheels: {}\nnames: 3 #ff8000", "2:8", "3 … list"),
        ("wheels: {}\nspare: true", "2:8", "true … fields"),
        ("wheels: {}\nnames: 7", "2:8", "7 … list"),
        ("wheels: {}\nmode: !secret x", "2:7", "tag '!secret' "),
        ("wheels: {}\nnames: ['\x01']", "2:10", "U+0001"),
        ('wheels: {}\nnames: ["\\ud800"]', "2:9", "half a character"),
        ("wheels: *nobody", "1:9", "undefined alias"),
        ("spare: {spokes: 0}\nwheels: {}", "1:17", "spare.spokes: 0 … whole number, … 1."),
    ],
)
def test_one_fault(text: str, place: str, words: str) -> None:
    (line,) = _faults(text)
    assert line.startswith(f"f.yaml:{place}: ")
    assert has_parts(line, words)


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "more than 20000 values"),
        ("wheels: &a [*a]", "nested more than"),
        ("wheels: " + "[" * 100_000, "nested more than"),
        ("wheels: " + "{a: " * 20_000, "nested more than"),
        ("#" * MAX_YAML_BYTES + "\nwheels: {}", "more than 256 KiB"),
    ],
    ids=["aliases", "a circle", "brackets", "mappings", "size"],
)
def test_bomb_is_a_fault(text: str, words: str) -> None:
    (line,) = _faults(text)
    assert words in line


def test_no_more_faults_are_told_than_somebody_reads() -> None:
    lines = _faults("wheels: {" + ", ".join(f"w{number}: 1" for number in range(80)) + "}")
    assert len(lines) == 51
    assert lines[-1].startswith("f.yaml:1:")
    assert lines[-1].endswith(": error: and 30 more")


def test_too_large_file_with_a_byte_order_mark_is_not_cut(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + b"#" * (MAX_YAML_BYTES - 10) + b"\nwheels: {}")
    with pytest.raises(BadFile, match="more than 256 KiB"):
        read_text(path)


def test_file_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_bytes(b"wheels: {}\nmode: caf\xe9\n")
    with pytest.raises(BadFile, match=r"f\.yaml:2:10: error: byte 0xe9 is not UTF-8"):
        read_text(path)
    with pytest.raises(BadFile, match="no such file"):
        read_text(tmp_path / "other.yaml")
    os.mkfifo(tmp_path / "fifo")
    for odd, kind in ((tmp_path, "directory"), (tmp_path / "fifo", "FIFO"), (Path(os.devnull), "device")):
        with pytest.raises(BadFile, match=rf"{odd.name}:1:1: error: is a {kind}, "):
            read_text(odd)
    path.write_bytes("\ufeffmode: fast\nwheels: {}".encode())
    assert read_yaml(read_text(path), "f", Wagon).mode == "fast"


def test_dangling_link_is_not_suggested_instead_of_itself(tmp_path: Path) -> None:
    (tmp_path / "plan.yaml").symlink_to(tmp_path / "gone.yaml")
    with pytest.raises(BadFile, match=r"plan\.yaml: error: .* file$"):
        read_text(tmp_path / "plan.yaml")
