"""File locks end with their holder. A program that changes a file waits for the lock, but not for ever."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from schemas.process.file_lock import FileLock

HOLDS = """
import sys, time
from pathlib import Path
from schemas.process.file_lock import FileLock
print(FileLock(Path(sys.argv[1])).try_take(), flush=True)
time.sleep(600)
"""


def test_file_lock_ends_with_its_holder(tmp_path: Path) -> None:
    path = tmp_path / "not" / "yet" / "there"
    with subprocess.Popen([sys.executable, "-c", HOLDS, str(path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "True\n"
        mine = FileLock(path)
        assert not mine.try_take()
        holder.kill()
        holder.wait()
    assert mine.try_take()
    assert mine.try_take(), "it is held already"
    assert not FileLock(path).try_take()
    mine.release()
    mine.release()
    assert not mine.is_held
    assert FileLock(path).try_take()


def test_changes_of_one_file_follow_each_other(tmp_path: Path) -> None:
    file = tmp_path / "number"
    file.write_text("0")

    def count(_: int) -> None:
        with FileLock(tmp_path / "lock").held():
            file.write_text(str(int(file.read_text()) + 1))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(count, range(40)))
    assert file.read_text() == "40"
