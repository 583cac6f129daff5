"""A write replaces a whole file, or leaves the old one."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from schemas.atomic_file import write_atomically


@pytest.mark.parametrize("sync", [False, True])
def test_file_is_replaced_and_keeps_its_mode(tmp_path: Path, sync: bool) -> None:
    path = tmp_path / "state.json"
    write_atomically(path, b"old", sync=sync)
    path.chmod(0o600)
    write_atomically(path, b"new", sync=sync)
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_failed_write_keeps_old_file_only(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    path.mkdir()
    with pytest.raises(OSError, match=r"state\.json"):
        write_atomically(path, b"new")
    assert list(tmp_path.iterdir()) == [path]


def test_readers_never_see_a_part_of_a_file_that_several_write(tmp_path: Path) -> None:
    path, end = tmp_path / "state.json", time.monotonic() + 0.5
    contents = [bytes([each]) * (10_000 + each) for each in range(4)]
    write_atomically(path, contents[0])

    def write(content: bytes) -> None:
        while time.monotonic() < end:
            write_atomically(path, content)

    with ThreadPoolExecutor() as pool:
        writers = [pool.submit(write, each) for each in contents]
        while time.monotonic() < end:
            assert path.read_bytes() in contents
        for each in writers:
            each.result()
    assert list(tmp_path.iterdir()) == [path]
