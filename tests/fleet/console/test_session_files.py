"""The names that are sessions of the folder, and the contents of a download."""

import io
import zipfile
from pathlib import Path

import pytest

from fleet.console.session_files import NotInFolder, files_of, read_file, session_path, zip_files
from fleet.recording.session_dir import SPARE_FILE


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Make a folder with one session of two files, beside a secret."""
    folder = tmp_path / "sessions"
    for directory in (folder / "one", tmp_path / "secret"):
        directory.mkdir(parents=True)
        for number, data in (("0001", b"\x89MCAP" * 99_999), ("0002", b"2")):
            (directory / f"{number}.mcap").write_bytes(data)
    (folder / "one" / SPARE_FILE).write_bytes(b"0")
    (folder / "one" / "0003.mcap").symlink_to(tmp_path / "secret" / "0001.mcap")
    (folder / "link").symlink_to(tmp_path / "secret")
    (folder / ".one.new").mkdir()
    (folder / "empty").mkdir()
    return folder


@pytest.mark.parametrize(
    "name",
    [
        "..",
        ".",
        "",
        "../secret",
        "one/../../secret",
        "/etc",
        "%2e%2e",
        "link",
        ".one.new",
        "empty",
        "two",
        "one/",
        "a\0b",
    ],
)
def test_no_name_leads_out_of_the_folder(place: Path, name: str) -> None:
    with pytest.raises(NotInFolder):
        session_path(place, name)
    with pytest.raises(NotInFolder):
        session_path(place / "none", name)


def test_download_has_files_as_they_are_and_no_links(place: Path) -> None:
    path = session_path(place, "one")
    assert path == place / "one"
    archive = zipfile.ZipFile(io.BytesIO(b"".join(zip_files(files_of(path), "one"))))
    assert archive.testzip() is None
    assert archive.namelist() == ["one/0001.mcap", "one/0002.mcap"]
    for name in archive.namelist():
        assert archive.read(name) == (place / name).read_bytes()
    assert [each.name for each in files_of(place / "one" / "0001.mcap")] == ["0001.mcap"]


def test_growing_file_is_read_as_far_as_it_reached(place: Path) -> None:
    path = place / "one" / "0001.mcap"
    size = path.stat().st_size
    parts = read_file(path)
    found = next(parts)
    with path.open("ab") as file:
        file.write(b"more")
    assert len(found + b"".join(parts)) == size
