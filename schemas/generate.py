"""Generates schemas/gen from schemas/proto, or checks that it is up to date (`make proto`, `make lint`)."""

import sys
import tempfile
from importlib import resources
from pathlib import Path

HERE = Path(__file__).parent
SOURCES = HERE / "proto"
GENERATED = HERE / "gen"


def generate(out: Path) -> list[Path]:
    """Run protoc on every .proto file. Return the files that it wrote into `out`.

    Protoc takes a generated module for one of the top level. Its classes get the name of the module that we import,
    else their messages cannot be pickled, and so not be returned by another process.
    """
    from grpc_tools import protoc  # type: ignore[import-untyped]  # ships no types

    includes = [f"-I{SOURCES}", f"-I{resources.files('grpc_tools') / '_proto'}"]
    sources = sorted(str(path) for path in SOURCES.glob("*.proto"))
    code = protoc.main(["protoc", *includes, f"--python_out={out}", f"--pyi_out={out}", *sources])
    if code != 0:
        raise SystemExit(code)
    for path in out.glob("*_pb2.py"):
        here = f"'{path.stem}', _globals"
        path.write_text(path.read_text().replace(here, f"'schemas.gen.{path.stem}', _globals"))
    return sorted(path for path in out.iterdir() if path.name.split(".")[0].endswith("_pb2"))


def main(arguments: list[str]) -> int:
    """Generate the files, and return 0. With --check, compare them with those in schemas/gen instead.

    If some differ, print their names and return 1.
    """
    if arguments != ["--check"]:
        for path in generate(GENERATED):
            sys.stdout.write(f"{path.relative_to(HERE.parent)}\n")
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        fresh = {path.name: path.read_bytes() for path in generate(Path(scratch))}
    checked_in = {path.name: path.read_bytes() for path in GENERATED.glob("*_pb2.py*")}
    stale = sorted(name for name in fresh.keys() | checked_in.keys() if fresh.get(name) != checked_in.get(name))
    if stale:
        sys.stderr.write(f"schemas/gen is not what schemas/proto generates: {', '.join(stale)}; run `make proto`\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
