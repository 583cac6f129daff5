"""The site: `python -m tests.tools.site DIRECTORY` lays out its sources there, for `zensical build`.

CONTRIBUTING.md and CHANGELOG.md are pages of the site, too. The configuration is above the pages, or the build
would publish it.
"""

import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FROM_TOP = {name: name.lower() for name in ("CONTRIBUTING.md", "CHANGELOG.md")}
CONFIGURATION = "zensical.toml"

if __name__ == "__main__":
    place = Path(sys.argv[1])
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(ROOT / "docs", place / "docs", ignore=shutil.ignore_patterns(CONFIGURATION))
    shutil.copy(ROOT / "docs" / CONFIGURATION, place)
    for source, target in FROM_TOP.items():
        shutil.copy(ROOT / source, place / "docs" / target)
